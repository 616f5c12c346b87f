"""What the Gaussians of a trained scene are, as rendered, and what they emit over time: all that an export needs of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import Frame, SceneData, SceneError, evenly_spread
from heatsplat.export.basis import EXAMINED, TimeBasis, ValuesAt, constant_basis, time_basis
from heatsplat.physics.units import kelvin
from heatsplat.renderers.base import ALPHA_MIN
from heatsplat.shots import at_time, first_free_id

TOLERANCE_C = 0.05  # °C that the basis of time may cost any Gaussian
TOLERANCE_UNIT = 0.001  # the same where image values are no temperatures
MANY = 50_000  # Gaussians; of more the truth, which is there to compare with, may err by
COARSER = 4  # times as much: else half of a page would be its
VIEWS = 6  # training cameras over which what depends on the view is averaged
JUDGED = 48  # training cameras at most that are compared with that mean
TIMES = 257  # samples of a quantity over time at most, and
BENDS = 3073  # where a weather record bends curves at each of its samples
CURVES = 192  # curves of a quantity at most
FEW_TIMES, FEW_CURVES = 65, 24  # the same of models for which
WORK = 4e10  # multiply-adds do not suffice; a minute of one thread
RECALLED = 4  # times as many under weather, where a moment goes on from what was marched before
MOMENTS = 2  # at which all Gaussians are asked for, for each curve
TABLE = 257  # entries of a table of temperatures for each range of blended values from 0 to 1, and
LARGEST = 2048  # at most: a texture of any graphics card is as wide


@dataclass(frozen=True)
class Layer:
    """One quantity of the Gaussians over time, in the units in which splats are blended.

    Args:
        name: "camera" (what they send to a camera), "surface" (their temperature, without what lies in between),
            "without <part>" (as "camera", with a part of the model taken out) or "truth" (of a synthetic scene).
        label: for people.
        basis: its values.
        worst: largest error of the basis in the scene's unit.
        tolerance: what was aimed at.
        clipped: values count as 0 below 0 and as 1 above 1. The basis holds them as they were before: clipping bends
            curves, and bent ones need more of them.
    """

    name: str
    label: str
    basis: TimeBasis
    worst: float
    tolerance: float
    clipped: bool = False


@dataclass(frozen=True)
class Snapshot:
    """The Gaussians that can be seen, and what is known of them. Geometry is that of the middle of the record.

    Args:
        means [N, 3], quats [N, 4] wxyz, scales [N, 3], opacities [N]: as rendered; float32.
        layers: what they emit; the first one is "camera".
        background: blended behind all.
        table: [257 or more] temperatures (in ``unit``) of blended values evenly from ``table_ends[0]`` to ``table_ends[1]``.
        unit: "°C", or empty where image values are no temperatures.
        limits: values that an image can show, in ``unit``.
        colours: [N, 3] of the visible image in [0, 1], or None; ``colour_opacities`` [N] are theirs.
        attributes: what the model learned, name -> [N], in the middle of the record.
        left_out: sentences about what the snapshot does not hold.
        start_s, end_s: span of time that it covers, all splits; None without times.
    """

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    layers: list[Layer]
    background: float
    table: Tensor
    table_ends: tuple[float, float]
    unit: str
    limits: tuple[float, float]
    colours: Tensor | None
    colour_opacities: Tensor | None
    attributes: dict[str, Tensor]
    left_out: list[str]
    start_s: float | None
    end_s: float | None

    @property
    def span(self) -> tuple[float, float] | None:
        """The two ends of the time that it covers; None without times."""
        return None if self.start_s is None else (self.start_s, self.end_s)

    def of(self, kept: Tensor) -> Snapshot:
        """The same of some of its Gaussians [N] bool."""

        def rows(values: Tensor | None) -> Tensor | None:
            return None if values is None else values[kept]

        bases = [layer.basis for layer in self.layers]
        bases = [replace(one, offsets=one.offsets[kept], coefficients=one.coefficients[kept]) for one in bases]
        return replace(
            self,
            **{name: getattr(self, name)[kept] for name in ("means", "quats", "scales", "opacities")},
            layers=[replace(layer, basis=basis) for layer, basis in zip(self.layers, bases, strict=True)],
            colours=rows(self.colours),
            colour_opacities=rows(self.colour_opacities),
            attributes={name: values[kept] for name, values in self.attributes.items()},
        )


@torch.no_grad()
def snapshot(module: Any, coarser: float = 1.0) -> Snapshot:
    """Takes one of a training module (``training.scene_model.SceneModel``) with its scene.

    What the Gaussians send may depend on where it is seen from. Then it is the mean over training cameras, and
    ``left_out`` says over which, and how far single cameras are from it, at worst, too.

    Args:
        module: with the scene that it was trained on.
        coarser: factor on TOLERANCE_C and TOLERANCE_UNIT: the coarser, the fewer moments are looked at.

    Raises:
        SceneError: the model's Gaussians cannot be told apart from it, or none can be seen.
    """
    if module.thermal.stays_here:
        raise SceneError(
            f"what {type(module.thermal).__name__} learned cannot be exported as Gaussians: {module.thermal.stays_here}. Render "
            "images of it (src/render.py), or train a method whose Gaussians stay as they are, such as method=3dgs"
        )
    visible, thermal_range = _Visible(module, coarser), module.scene.thermal_range
    left_out = [*visible.said_of_views, *visible.said_of_motion()]
    layers = visible.layers()
    background = module.background[0].item()
    table_ends = _ends(layers, background)
    colours, colour_opacities = visible.colours()
    start_s, end_s = visible.span or (None, None)
    return Snapshot(
        means=visible.means.float().cpu(),
        quats=torch.nn.functional.normalize(visible.quats.float(), dim=1).cpu(),
        scales=visible.scales.float().cpu(),
        opacities=visible.opacities[0].float().cpu(),
        layers=layers,
        background=background,
        table=visible.table(table_ends),
        table_ends=table_ends,
        unit=visible.unit,
        limits=(thermal_range.min_c, thermal_range.max_c) if visible.unit else (0.0, 1.0),
        colours=colours,
        colour_opacities=colour_opacities,
        attributes=visible.attributes(),
        left_out=left_out,
        start_s=start_s,
        end_s=end_s,
    )


@dataclass(frozen=True)
class _Effort:
    """How far a basis of time may go: samples over time and curves at most, and the times at which quantities may bend."""

    times: int
    curves: int
    bends: Sequence[float]


class _Visible:
    """The Gaussians of a module that can be seen, as rendered in the middle of the record, and what they send over time.

    Quantities over time (``camera``, ``surface``, ``truth``, ``without``) are blended values [T, n] at some moments, of all of
    them or of those with some numbers among them.

    Attributes:
        span: of time that is covered; None where nothing changes.
        kept: their numbers among all of the module.
        means, quats, scales, opacities [M, N]: of them.
        unit: of the scene, and ``to_unit`` what an image value of 1 is in it.
        slope: largest change of the image, in that unit, for one of a blended value.
        tolerance: what a basis of time may cost, in that unit.
        cameras: training cameras over which what they send is averaged; one where it does not depend on the camera.
        look: [N, C] image values, mean over several cameras.
        said_of_views: what a snapshot leaves out of that, in sentences.
    """

    def __init__(self, module: Any, coarser: float = 1.0) -> None:
        self.module, self.scene = module, module.scene
        train = self.scene.train
        self.span = span_of(self.scene)
        self.middle = None if self.span is None else self.scene.middle_s
        self._free_id = first_free_id(self.scene)
        self.frame = self._at(train.frames[0], self.middle)
        means, quats, scales, opacities = module.shapes(self.frame)
        seen = (opacities.amax(0) >= ALPHA_MIN) & means.isfinite().all(1) & quats.any(1)  # as renderers have it
        self.kept = seen.nonzero()[:, 0]
        if not len(self.kept):
            raise SceneError(
                f"none of the {len(means)} Gaussians of scene '{self.scene.name}' can be seen (opacities are below "
                f"{ALPHA_MIN:.2g}): train it again, or take an earlier checkpoint"
            )
        self.means, self.quats, self.scales = means[self.kept], quats[self.kept], scales[self.kept]
        self.opacities = opacities[:, self.kept]
        self._points = self.means.cpu()
        self.channels = module.thermal.modality_channels[0]
        self.to_unit, self.unit = _scale(self.scene, module.modality)
        self.slope = self._slope()
        self.tolerance = coarser * (TOLERANCE_C if self.unit else TOLERANCE_UNIT)
        self.cameras, self.look, self.said_of_views = self._views()

    def _at(self, frame: Frame, time_s: float | None) -> Frame:
        """What the camera of a frame would see at a moment, as a frame that is none of the scene's."""
        frame = replace(frame, frame_id=self._free_id)
        return frame if time_s is None else at_time(self.scene, frame, time_s)

    def _emitted(self, frame: Frame, time_s: float | None, ids: Tensor | None = None) -> Tensor:
        """Image values [n, C] that are sent to the camera of a frame at a moment."""
        wanted = self.kept if ids is None else self.kept[ids]
        return self.module.emissions(self.module.splats, self._at(frame, time_s), wanted)

    def _blended(self, values: Tensor) -> Tensor:
        """Blended values [n] of image values [n, C]."""
        return self.module.composite.encode(values, self.channels)[:, : self.channels].mean(1).nan_to_num()

    def _blended_units(self, values: Tensor) -> Tensor:
        """Blended values [T, n] of image values [T, n] of one channel."""
        return self._blended(values.reshape(-1, 1)).reshape(values.shape)

    def _slope(self) -> float:
        values = torch.linspace(0, 1, TABLE, dtype=torch.float64)
        steps = self._blended(values[:, None].expand(-1, self.channels)).diff()
        return self.to_unit / (TABLE - 1) / steps.min().item()

    def _views(self) -> tuple[list[Frame], Tensor, list[str]]:
        """``cameras``, ``look`` and ``said_of_views``."""
        train = self.scene.train
        cameras = [train.frames[i] for i in evenly_spread(len(train), VIEWS)]
        looks = torch.stack([self._emitted(frame, self.middle) for frame in cameras])
        mean = looks.mean(0)
        spread = (looks[..., : self.channels] - mean[:, : self.channels]).mean(-1) * self.to_unit
        if not spread.abs().max() > self.tolerance / 5:
            return cameras[:1], mean, []
        worst = 0.0
        for i in evenly_spread(len(train), JUDGED):
            off = (self._emitted(train.frames[i], self.middle) - mean)[:, : self.channels].mean(1) * self.to_unit
            worst = max(worst, float(off.abs().max()))
        said = (
            f"What a Gaussian sends depends on the view: baked, whichever way it is looked at, is the mean of what it sends to "
            f"{len(cameras)} training cameras ({', '.join(frame.name for frame in cameras)}). Single ones differ from it by "
            f"{spread.square().mean().sqrt():.2g} {self.unit} (root mean square), any training camera by {worst:.2g} {self.unit} "
            "at worst; from where none looked it may be more. src/render.py shows what each direction gets."
        )
        return cameras, mean, [said]

    def said_of_motion(self) -> list[str]:
        """What a snapshot leaves out of the motion of Gaussians, in sentences."""
        if self.span is None:
            return []
        first = self.scene.train.frames[0]
        start, end = (self.module.shapes(self._at(first, time_s))[0][self.kept] for time_s in self.span)
        moved = float((end - start).norm(dim=1).max()) / self.scene.extent
        if not moved > 0:
            return []
        return [
            f"The model moves its Gaussians over time, by up to {moved:.2g} of the scene's extent: shown are their places in "
            "the middle of the record."
        ]

    # Quantities over time ------------------------------------------------------------------------------------------------

    def camera(self, moments_s: Sequence[float | None], ids: Tensor | None = None) -> Tensor:
        """What they send to a camera."""
        return torch.stack([self._sent(time_s, ids) for time_s in moments_s])

    def _sent(self, time_s: float | None, ids: Tensor | None) -> Tensor:
        """``camera`` at a moment, [n]."""
        return self._blended(torch.stack([self._emitted(frame, time_s, ids) for frame in self.cameras]).mean(0))

    def without(self, part: str, moments_s: Sequence[float | None], ids: Tensor | None = None) -> Tensor:
        """What they would send to a camera without a part of the model."""
        with self.module.thermal.without(part):
            return self.camera(moments_s, ids)

    def surface(self, moments_s: Sequence[float], ids: Tensor | None = None) -> Tensor:
        """The temperature of the surface, of models that tell one (``_tells_surface``)."""
        wanted = self.kept if ids is None else self.kept[ids]
        temperatures_k = self.module.thermal.temperatures(self.module.splats, moments_s, wanted)
        lowest_k, span_k = kelvin(self.scene.thermal_range.min_c), self.scene.thermal_range.span_k
        return self._blended_units((temperatures_k - lowest_k) / span_k)

    def _tells_surface(self) -> bool:
        if self.span is None or not self.unit:
            return False
        return self.module.thermal.temperature(self.module.splats, self.scene.record[0]) is not None

    def truth(self, moments_s: Sequence[float], ids: Tensor | None = None) -> Tensor:
        """The true temperature at their places, of scenes that know it."""
        wanted = self._points if ids is None else self._points[ids]
        celsius = self.scene.truth(wanted, torch.tensor(moments_s, dtype=torch.float64)).T
        return self._blended_units(self.scene.thermal_range.to_unit(celsius).float())

    def _alike(self, one: ValuesAt, other: ValuesAt) -> bool:
        """Whether two quantities are the same at some moments, to a tenth of the tolerance."""
        least = 0.1 * (self.tolerance / self.slope)
        if self.span is None:
            return bool((one([None]) - other([None])).abs().max() <= least)
        start, end = self.span
        moments = (start + share * (end - start) for share in (0.0, 0.37, 0.5, 0.81, 1.0))
        return all((one([moment]) - other([moment])).abs().max() <= least for moment in moments)

    # Layers --------------------------------------------------------------------------------------------------------------

    def layers(self) -> list[Layer]:
        """What they send over time, with what the model and the scene tell beside it; the camera first."""
        thermal, effort, tells_surface = self.module.thermal, self._effort(), self._tells_surface()
        clipped = tells_surface and self._alike(_inside(self.surface), self.camera)
        sent = self.surface if clipped else self.camera
        layers = [self._layer("camera", "as seen", sent, effort, clipped=clipped)]
        if tells_surface and not clipped and not self._alike(_inside(self.surface), _inside(self.camera)):
            layers.append(self._layer("surface", "of the surface", self.surface, effort))
        for part in thermal.removable:
            without = partial(self.without, part)
            if not self._alike(without, self.camera):
                name = f"without {part}"
                layers.append(self._layer(name, name.replace("_", " "), without, effort))
        if self.scene.truth is not None and self.span is not None and self.scene.thermal_range is not None:
            record = self._record()
            most = _Effort(BENDS if record else TIMES, CURVES, record)
            coarser = COARSER if len(self.kept) > MANY else 1
            layers.append(self._layer("truth", "truth", self.truth, most, coarser))
        return layers

    def _record(self) -> tuple[float, ...]:
        """Times of the samples of the weather record; none without one."""
        return () if self.scene.weather is None else tuple(self.scene.weather.times_s.tolist())

    def _effort(self) -> _Effort:
        """What a layer of the model may take: the more, the less it costs to ask all Gaussians at one moment."""
        thermal, count = self.module.thermal, len(self.kept)
        bends = self._record() if "weather" in thermal.needs else ()
        work = WORK * (RECALLED if bends else 1) / (max(thermal.cost, 1) * len(self.cameras))
        times = int(min(BENDS if bends else TIMES, max(FEW_TIMES, work / min(count, EXAMINED))))
        curves = int(min(CURVES, max(FEW_CURVES, work / (MOMENTS * max(count, 1)))))
        return _Effort(times, curves, bends)

    def _layer(
        self, name: str, label: str, values_at: ValuesAt, effort: _Effort, coarser: int = 1, clipped: bool = False
    ) -> Layer:
        tolerance = self.tolerance / self.slope * coarser
        if self.span is None:
            basis = constant_basis(values_at([None], None)[0].cpu())
        else:
            basis = time_basis(
                values_at, len(self.kept), *self.span, tolerance, effort.times, effort.curves, effort.bends, clipped
            )
        return Layer(name, label, basis, basis.worst * self.slope, tolerance * self.slope, clipped)

    # Beside the layers ---------------------------------------------------------------------------------------------------

    def table(self, ends: tuple[float, float]) -> Tensor:
        """``Snapshot.table`` between two blended values."""
        # As fine where single Gaussians widen it: of radiance, temperatures between entries are not on a straight line.
        entries = 1 + min(math.ceil((TABLE - 1) * (ends[1] - ends[0])), LARGEST - 1)
        values = torch.linspace(*ends, entries, dtype=torch.float64)[:, None].expand(-1, self.channels)
        shown = self.module.composite.decode(values, self.channels)[:, 0]
        return (self.scene.thermal_range.to_celsius(shown) if self.unit else shown).float()

    def colours(self) -> tuple[Tensor | None, Tensor | None]:
        """Colours [N, 3] of the visible image and their opacities [N], where the model has them."""
        thermal, start = self.module.thermal, 0
        for place, (name, count) in enumerate(thermal.images):
            if count == 3 and (name == "rgb" or place == 0):
                opacities = self.opacities[0 if thermal.shared_opacity else place]
                return self.look[:, start : start + 3].clamp(0, 1).float().cpu(), opacities.float().cpu()
            start += count
        return None, None

    def attributes(self) -> dict[str, Tensor]:
        """What the model learned, name -> [N], in the middle of the record."""
        learned = self.module.attributes(self.frame)
        return {name: values[self.kept].float().cpu() for name, values in learned.items()}


def span_of(scene: SceneData) -> tuple[float, float] | None:
    """First and last moment of all views; None without times or where all are the same."""
    if "time" not in scene.metadata:
        return None
    times = [time for views in (scene.train, scene.val, scene.test) for time in views.times_s if time is not None]
    return (min(times), max(times)) if max(times) > min(times) else None


def _scale(scene: SceneData, modality: str) -> tuple[float, str]:
    """What an image value of 1 is in the unit of the scene, and that unit."""
    bounds = scene.range_of(modality)
    return (1.0, "") if bounds is None else (bounds.span_k, "°C")


def _inside(values_at: ValuesAt) -> ValuesAt:
    """A quantity where the image can show it."""
    return lambda moments, ids=None: values_at(moments, ids).clamp(0, 1)


def _ends(layers: list[Layer], background: float) -> tuple[float, float]:
    """Range of blended values that a pixel of any layer can have."""
    low, high = min(0.0, background), max(1.0, background)
    for layer in (layer for layer in layers if not layer.clipped):
        basis = layer.basis
        reach = (basis.coefficients.abs() @ basis.curves.abs()).amax(1) if basis.rank else torch.zeros(1)
        low = min(low, (basis.offsets - reach).min().item())
        high = max(high, (basis.offsets + reach).max().item())
    return low, high
