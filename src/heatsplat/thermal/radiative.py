"""RaViGS: every Gaussian is a grey body that emits and reflects in the thermal band, and it has a visible colour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor, nn
from torch.nn.functional import softplus

from heatsplat.contracts import SceneData, SceneError, check_option
from heatsplat.geometry import spherical_harmonics
from heatsplat.physics.grey_body import radiance, temperature_of
from heatsplat.same_bits import everywhere, sigmoid
from heatsplat.splats import Splats
from heatsplat.thermal.band_scale import DEGREE, BandScale
from heatsplat.thermal.base import PerGaussian, Query, Seeds, ThermalModel
from heatsplat.thermal.clipping import CLIPS, clipped
from heatsplat.thermal.coordinates import ImageRange
from heatsplat.thermal.view_harmonics import BASIS_COST, spherical_harmonics_of
from heatsplat.thermal.wrapper import Wrapper

DEGREES = {"emissivity": 1, "temperature": 1, "reflectance": 0}
ATTRIBUTES = tuple(DEGREES)
REFLECTANCES = ("free", "kirchhoff")
LAWS = ("grey", "band")
MEASURED = "measured"
START = (0.05, 0.98)  # of temperature: below, 4 T³ leaves hardly a gradient; above, hardly the sigmoid's


class Radiative(Wrapper):
    """Thermal emission clip(ε σ T⁴ + ρ L, 0, 1) beside a colour image, on the same Gaussians (RaViGS, Eq. 4-9).

    Emissivity ε, temperature T and reflectance ρ of a Gaussian are sigmoids of spherical harmonics of the direction of
    view; the gain σ and the radiance L of the surroundings belong to the scene. Each image has opacities of its own, so
    that a pane may be clear in one band and opaque in the other.

    **Convention:** everything is in image units. Only the sum ε σ T⁴ + ρ L is observed, so that T orders surfaces by
    heat but is no temperature in kelvin; temperatures are those of the image, through the scene's range.

    With ``law="band"`` (ours) T is the image value of a black body of the surface's temperature, and the emission that of
    a black body which sends as much in the camera's band: B(v) = ε B(T) + (1 - ε) B(L). Of a surface that looks the same
    from all sides only this sum is observed, too: its ε stays where it started, and T is right as far as ε is.

    Tensors: "emissivity", "temperature", "reflectance" [N, 1, 1] (the constant harmonic, before the sigmoid) and, from
    degree 1, "emissivity_rest" and so on, [N, B - 1, 1]; those of ``color``. Without the three parameters there is
    "radiance" in their place.

    Args:
        color: model of the visible image, of modality "rgb", such as ``Static``.
        three_parameter: False emits max(0, 1/2 + harmonics) as 3DGS does, without ε, T, ρ, σ and L (Tab. 3).
        dual_opacity: False composites both images with one opacity (Tab. 3).
        reflectance: "free", as the paper has it, or "kirchhoff": ρ = 1 - ε, as it is for opaque bodies.
        law: of emission: "grey", ε σ T⁴ + ρ L (paper), or "band", Planck's in the camera's band, for opaque bodies.
        degrees: degree of the harmonics of each attribute, 0 to 3; that of "temperature" serves "radiance" too.
        emissivity, reflectance_start, gain, surroundings: ε, ρ, σ and L before training. T starts at what then gives
            the grey value of the training images, within 0.05 and 0.98. None is the gain with which 0.98 gives white: with
            a lower one no Gaussian starts as bright as images are. Of the surroundings, "measured" keeps L at the scene's
            ambient temperature.
        clip: how values above 1 are shown: "straight_through" clamps them but lets gradients pass; "hard" stops their
            gradient (the paper's Eq. 5); "none" shows them as they are.
        color_l2: λ_sh, weight of the squared higher harmonics of the colour, summed over harmonics and channels and
            averaged over Gaussians (Eq. 14); applied inside the optimiser. 0 leaves it out.
        lr_attributes: learning rate of constant harmonics of ε, T and ρ; not paced, as the recipe's follows the run.
        lr_rest: that of the further ones.
        lr_attributes_end: factor on both at the end of the run.
        lr: learning rate of σ and L before softplus and sigmoid.

    Raises:
        ValueError: an option is unknown, a value is out of its range, or options do not go together.
    """

    def __init__(
        self,
        color: ThermalModel,
        three_parameter: bool = True,
        dual_opacity: bool = True,
        reflectance: str = "free",
        law: str = "grey",
        degrees: Mapping[str, int] = DEGREES,
        emissivity: float = 0.9,
        reflectance_start: float = 0.1,
        gain: float | None = None,
        surroundings: float | str = 0.2,
        clip: str = "straight_through",
        color_l2: float = 5e-5,
        lr_attributes: float = 2.5e-3,
        lr_rest: float = 1.25e-4,
        lr_attributes_end: float = 1.0,
        lr: float = 1e-3,
    ) -> None:
        super().__init__({"color": color}, own_channels=1)
        check_option("reflectance", reflectance, REFLECTANCES)
        check_option("law", law, LAWS)
        check_option("clip", clip, CLIPS)
        measured = surroundings == MEASURED
        shares = [emissivity, reflectance_start, *([] if measured else [surroundings])]
        if not (all(0 < share < 1 for share in shares) and (gain is None or gain > 0)):
            raise ValueError(
                "emissivity, reflectance_start and surroundings (or measured) lie between 0 and 1 and gain is positive, got "
                f"{emissivity}, {reflectance_start}, {surroundings} and {gain}"
            )
        if color.modality != "rgb" or color.companions:
            raise ValueError(f"color must explain rgb images and nothing else, got a model of {color.modality} images")
        if set(degrees) != set(ATTRIBUTES):
            raise ValueError(f"degrees must name {', '.join(ATTRIBUTES)}, got {', '.join(degrees)}")
        if law == "band" and not (three_parameter and reflectance == "kirchhoff"):
            raise ValueError(
                "law=band is that of opaque bodies: it goes with three_parameter and reflectance=kirchhoff"
            )
        self.three_parameter, self.kirchhoff, self.clip = three_parameter, reflectance == "kirchhoff", clip
        if not three_parameter:
            self.degrees = {"radiance": degrees["temperature"]}
        else:
            self.degrees = {name: degrees[name] for name in ATTRIBUTES[: 2 if self.kirchhoff else 3]}
        self.bands = {name: spherical_harmonics.band_count(degree) for name, degree in self.degrees.items()}
        self.shared_opacity = not dual_opacity
        self.emissivity, self.reflectance = emissivity, 1 - emissivity if self.kirchhoff else reflectance_start
        self.color_l2, self.lr = color_l2, lr
        self.lr_attributes, self.lr_rest, self.lr_attributes_end = lr_attributes, lr_rest, lr_attributes_end
        self.band = BandScale() if law == "band" else None
        self.range = ImageRange() if law == "band" else None
        if three_parameter and measured:
            self.register_buffer("ambient", torch.tensor(0.5))
        elif three_parameter:
            self.raw_surroundings = nn.Parameter(torch.logit(torch.tensor(surroundings)))
        if three_parameter and law == "grey":
            self._white = gain is None
            raw = _raw_of(torch.tensor(1.0 if gain is None else gain, dtype=torch.float64))
            self.raw_gain = nn.Parameter(raw.float())
            self._set_white()

    @property
    def gain(self) -> Tensor:
        """σ, positive."""
        return softplus(self.raw_gain)

    @property
    def surroundings(self) -> Tensor:
        """L: in (0, 1) where it is learned, and what was measured else."""
        return self.ambient if "ambient" in self._buffers else self.raw_surroundings.sigmoid()

    @torch.no_grad()
    def _set_white(self) -> None:
        if self._white:
            mirrored = self.reflectance * self.surroundings
            if not mirrored < 1.0:
                raise SceneError(
                    f"surfaces that reflect {self.reflectance:g} of surroundings at an image value of {self.surroundings:.3g} "
                    "are white before they emit, so that no gain makes T = 0.98 white: give thermal.gain, a smaller "
                    "thermal.reflectance_start, or the scene a range of temperatures that its surroundings are nearer to"
                )
            gain = (1.0 - mirrored) / (self.emissivity * START[1] ** 4)
            self.raw_gain.copy_(_raw_of(gain))

    # What the contract asks -----------------------------------------------------------------------------

    def prepare(self, scene: SceneData) -> None:
        super().prepare(scene)
        if "ambient" in self._buffers:
            if scene.thermal_range is None or scene.ambient_c is None:
                raise SceneError(
                    f"thermal.surroundings=measured needs the ambient temperature, which scene '{scene.name}' does not say; "
                    "give it to the data set, or learn the surroundings with a number in (0, 1) to start from"
                )
            self.ambient.fill_(scene.thermal_range.to_unit(scene.ambient_c))
            if self.band is None:
                self._set_white()
        if self.band is not None:
            self.band.prepare(scene)
            self.range.prepare(scene)

    @torch.no_grad()
    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        grey, tensors = seeds.values[:, :1], {}
        for name, start in self._starts(grey).items():
            constant = start[:, None] / spherical_harmonics.C0
            tensors[name] = PerGaussian(constant, self.lr_attributes, lr_end=self.lr_attributes_end, paced=False)
            if self.bands[name] > 1:
                rest = grey.new_zeros(len(grey), self.bands[name] - 1, 1)
                tensors[f"{name}_rest"] = PerGaussian(rest, self.lr_rest, lr_end=self.lr_attributes_end, paced=False)
        colored = super().per_gaussian(seeds)
        for name, part in colored.items():
            if name.endswith("_rest") and self.color_l2 > 0:
                colored[name] = replace(part, l2=self.color_l2, l2_mean=True)
        return tensors | colored

    def _starts(self, grey: Tensor) -> dict[str, Tensor]:
        """What the sums of harmonics start at, by name of attribute, [N, 1]: they give the grey values [N, 1]."""
        if not self.three_parameter:
            return {"radiance": grey - 0.5}
        emissivity, reflectance = torch.full_like(grey, self.emissivity), torch.full_like(grey, self.reflectance)
        if self.band is None:
            temperature = temperature_of(grey, emissivity, self.gain, reflectance, self.surroundings)
        else:
            others = (1.0 - emissivity) * self.band.radiance_of(self.surroundings)
            own = (self.band.radiance_of(grey) - others) / emissivity
            temperature = self.band.value_of(own.clamp(min=0.0).sqrt().sqrt())
        temperature = temperature.clamp(*START)
        values = {"emissivity": emissivity, "temperature": temperature, "reflectance": reflectance}
        return {name: torch.logit(values[name]) for name in self.degrees}

    def features(self, splats: Splats, query: Query) -> Tensor:
        return torch.cat((self._heat(splats, query), self.color.features(splats, query)), dim=1)

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        """Emissivity, temperature (as "relative_temperature" in (0, 1), no kelvin) and reflectance; none of them without the
        three parameters."""
        told = super().attributes(splats, query)
        if not self.three_parameter:
            return told
        body = {name: values[:, 0] for name, values in self._body(splats, query).items()}
        return told | {"relative_temperature" if name == "temperature" else name: body[name] for name in body}

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor | None:
        """Of bodies that send by Planck's law; the mean over directions of what it is before the sigmoid counts."""
        if self.band is None:
            return super().temperature(splats, time_s, ids)
        return self.range.kelvin((spherical_harmonics.C0 * Query(ids).rows(splats["temperature"])[:, 0, 0]).sigmoid())

    def effects(self) -> dict[str, dict]:
        effects = super().effects()
        if self.three_parameter:
            law = "ε σ T⁴" if self.band is None else "ε B(T)"
            effects["radiation"] = {"law": law, "degrees": dict(self.degrees)}
            effects["reflection"] = {"reflectance": "1 - ε" if self.kirchhoff else "learned"}
        if not self.shared_opacity:
            effects["thermal_opacity"] = {"opacities": len(self.opacity_channels)}
        return effects

    @property
    def cost(self) -> int:
        formula = 6 + 4 * len(self.degrees) if self.three_parameter else 1  # the sum, and a sigmoid per attribute
        formula += 0 if self.band is None else 2 * DEGREE + 10  # the two polynomials and roots
        sums = sum(BASIS_COST[degree] + self.bands[name] for name, degree in self.degrees.items())
        return super().cost + formula + sums

    # The thermal band -----------------------------------------------------------------------------------

    def _heat(self, splats: Splats, query: Query) -> Tensor:
        """What is emitted in the thermal band, [n, 1]."""
        if not self.three_parameter:
            return (self._sum(splats, query, "radiance") + 0.5).clamp(min=0.0)
        body = self._body(splats, query)
        if self.band is not None:
            own, others = (self.band.radiance_of(values) for values in (body["temperature"], self.surroundings))
            sent = torch.lerp(everywhere(others.to(own), own), own, body["emissivity"])
            return self.band.value_of(sent.sqrt().sqrt())
        gain, surroundings = (everywhere(number, body["emissivity"]) for number in (self.gain, self.surroundings))
        sent = radiance(body["emissivity"], body["temperature"], gain, body["reflectance"], surroundings)
        return clipped(sent, self.clip)

    def _body(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        """ε, T and ρ in the direction of view, each [n, 1]."""
        body = {name: sigmoid(self._sum(splats, query, name)) for name in self.degrees}
        return body | {"reflectance": 1.0 - body["emissivity"]} if self.kirchhoff else body

    def _sum(self, splats: Splats, query: Query, name: str) -> Tensor:
        """The sum of harmonics of an attribute, [n, 1]."""
        degree = self.degrees[name]
        rest = splats[f"{name}_rest"] if degree > 0 else None
        return spherical_harmonics_of(splats[name], rest, splats.means, query, degree)


def _raw_of(gain: Tensor) -> Tensor:
    """What softplus, which leaves values above 20 as they are, makes a gain of; e to large ones would overflow."""
    return torch.where(gain > 20.0, gain, gain.expm1().log())
