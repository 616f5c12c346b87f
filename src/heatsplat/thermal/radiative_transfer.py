"""PhysIR-Splat: temperature, emissivity and surroundings of every Gaussian, and what of their radiance reaches the camera."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from heatsplat.contracts import SceneData, check_numbers, check_option, quantile
from heatsplat.same_bits import everywhere, sigmoid
from heatsplat.splats import Splats
from heatsplat.thermal.attenuation import Attenuation
from heatsplat.thermal.band_scale import DEGREE, BandScale
from heatsplat.thermal.base import KELVIN_RANGE, PerGaussian, Query, Seeds, ThermalModel
from heatsplat.thermal.clipping import CLIPS, clipped
from heatsplat.thermal.wrapper import Wrapper

MARGIN = 0.25  # beyond the image's range, image units: a surface of ε < 1 shows less than it is


class RadiativeTransfer(Wrapper):
    """τ (ε B(T) + (1 - ε) B(E)) + (1 - τ) B(A) in the camera's band, as the image value of a black body (PhysIR-Splat).

    T is what the state says, ε and E are those of the Gaussian: emissivity, and the temperature of the surroundings that it
    mirrors. τ and A are transmission and temperature of the air. B is Planck's law over the camera's band, so that the
    sum is one of radiances.

    **Convention:** images tell only the sum. ε and E therefore rest where priors pull them unless views differ (through the
    air) or the state changes with time. The paper's networks after the renderer are left out; so is its pose regression.

    Tensors, beside the state's: "emissivity_offset" [N], added to the logit of ε within its bounds, and "surroundings_offset"
    [N], added to the level of the surroundings, in image units. Both start at 0, where their priors are.

    Args:
        state: temperatures of the surface in image units, not clipped; one channel.
        air: between surface and camera, or None for none.
        band: ends of the camera's band in micrometres.
        bounds: of ε.
        emissivity: ε at the start and of the prior, within the bounds.
        surroundings_quantile: of the seeds' values, which is where the surroundings start in a scene without an ambient
            temperature.
        emissivity_l2, surroundings_l2: weights of the priors, the mean over Gaussians of the squared offsets.
        lr_emissivity, lr_surroundings: learning rates of the offsets.
        clip: how values outside the image's range are shown: "straight_through", "hard" or "none".

    Raises:
        ValueError: an option is unknown or out of its range, or the state does not explain one thermal channel.
    """

    narrowest_range_k = KELVIN_RANGE

    def __init__(
        self,
        state: ThermalModel,
        air: Attenuation | None = None,
        band: tuple[float, float] = (7.5, 13.5),
        bounds: tuple[float, float] = (0.85, 0.99),
        emissivity: float = 0.95,
        surroundings_quantile: float = 0.1,
        emissivity_l2: float = 0.01,
        surroundings_l2: float = 0.01,
        lr_emissivity: float = 5e-3,
        lr_surroundings: float = 1e-3,
        clip: str = "straight_through",
    ) -> None:
        check_option("clip", clip, CLIPS)
        if state.modality_channels != (1,):
            raise ValueError(f"the state must explain one channel, got {state.modality_channels}")
        check_numbers("band", band, 2)
        check_numbers("bounds", bounds, 2)
        least, most = bounds
        if not 0 < least < emissivity < most <= 1 or not 0 <= surroundings_quantile <= 1:
            raise ValueError(
                "emissivity must lie between its bounds, those in (0, 1], and surroundings_quantile in [0, 1], got "
                f"{emissivity}, {tuple(bounds)} and {surroundings_quantile}"
            )
        super().__init__({"state": state, "air": air}, needs={"thermal_range"})
        self.scale = BandScale(*band, margin=MARGIN)
        self.least, self.span = least, most - least
        share = (emissivity - least) / self.span
        self.start = math.log(share / (1.0 - share))
        self.quantile, self.clip = surroundings_quantile, clip
        self.emissivity_l2, self.surroundings_l2 = emissivity_l2, surroundings_l2
        self.lr_emissivity, self.lr_surroundings = lr_emissivity, lr_surroundings
        self.register_buffer("level", torch.tensor(torch.nan))  # of the surroundings before training, image units

    def prepare(self, scene: SceneData) -> None:
        super().prepare(scene)
        self.scale.prepare(scene)
        if scene.ambient_c is not None:
            self.level.fill_(scene.thermal_range.to_unit(scene.ambient_c))

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        if self.level.isnan():
            self.level.copy_(quantile(seeds.values[:, 0], self.quantile))
        zeros = seeds.values.new_zeros(len(seeds.means))
        return super().per_gaussian(seeds) | {
            "emissivity_offset": PerGaussian(zeros, self.lr_emissivity, l2=self.emissivity_l2, l2_mean=True),
            "surroundings_offset": PerGaussian(
                zeros.clone(), self.lr_surroundings, l2=self.surroundings_l2, l2_mean=True
            ),
        }

    def changed(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        emissivity, surroundings = self._surface(splats, query)
        sent = torch.lerp(self._radiance(surroundings), self._radiance(values), emissivity)
        if self.air is not None:
            of_air = everywhere(self._radiance(self.air.level), sent)
            sent = torch.lerp(of_air, sent, self.air.transmission(splats, query))
        return clipped(self.scale.value_of(sent.sqrt().sqrt()), self.clip)

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        """Emissivity, and what a surface mirrors in image units, beside what the members tell."""
        emissivity, surroundings = self._surface(splats, query)
        return super().attributes(splats, query) | {
            "emissivity": emissivity[:, 0],
            "surroundings": surroundings[:, 0],
        }

    def effects(self) -> dict[str, dict]:
        own = {
            "radiation": {"law": "ε B(T)", "band_um": [self.scale.band.shortest_um, self.scale.band.longest_um]},
            "reflection": {"reflectance": "1 - ε", "surroundings": "per Gaussian"},
        }
        return super().effects() | own

    @property
    def cost(self) -> int:
        return super().cost + 3 * DEGREE + 2 * DEGREE + 20  # polynomials of T, E and back; powers, sigmoid, mixing

    def _surface(self, splats: Splats, query: Query) -> tuple[Tensor, Tensor]:
        """ε and E of the Gaussians in view, each [n, 1]; E in image units."""
        offset = query.rows(splats["emissivity_offset"])[:, None]
        surroundings = self.level + query.rows(splats["surroundings_offset"])[:, None]
        return self.least + self.span * sigmoid(self.start + offset), surroundings

    def _radiance(self, values: Tensor) -> Tensor:
        """Of black bodies that look like ``values``, over that of white."""
        return self.scale.radiance_of(self.scale.within(values))
