"""What the Gaussians of a trained scene are, as rendered, and what they emit over time: all that an export needs of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
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
TABLE = 257  # entries of a table of temperatures


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
        table: [257] temperatures (in ``unit``) of blended values evenly from ``table_ends[0]`` to ``table_ends[1]``.
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


@torch.no_grad()
def snapshot(module: Any) -> Snapshot:
    """Takes one of a training module (``training.scene_model.SceneModel``) with its scene.

    What the Gaussians send may depend on where it is seen from. Then it is the mean over training cameras, and
    ``left_out`` says over which, and how far single cameras are from it, at worst, too.

    Raises:
        SceneError: the model's Gaussians cannot be told apart from it, or none can be seen.
    """
    if module.thermal.stays_here:
        raise SceneError(
            f"what {type(module.thermal).__name__} learned cannot be exported as Gaussians: {module.thermal.stays_here}. Render "
            "images of it (src/render.py), or train a method whose Gaussians stay as they are, such as method=3dgs"
        )
    scene: SceneData = module.scene
    span = span_of(scene)
    middle = None if span is None else scene.middle_s
    first = scene.train.frames[0]
    own_id = first_free_id(scene)

    def seen_at(frame: Frame, time_s: float | None) -> Frame:
        frame = replace(frame, frame_id=own_id)
        return frame if time_s is None else at_time(scene, frame, time_s)

    means, quats, scales, opacities = module.shapes(seen_at(first, middle))
    kept = ((opacities.amax(0) >= ALPHA_MIN) & means.isfinite().all(1)).nonzero()[:, 0]
    if not len(kept):
        raise SceneError(
            f"none of the {len(means)} Gaussians of scene '{scene.name}' can be seen (opacities are below {ALPHA_MIN:.2g}): "
            "train it again, or take an earlier checkpoint"
        )
    channels = module.thermal.modality_channels[0]

    def emitted(frame: Frame, ids: Tensor | None = None) -> Tensor:
        return module.emissions(module.splats, frame, kept if ids is None else kept[ids])

    def blended(values: Tensor) -> Tensor:
        """Blended values [N] of image values [N, C]."""
        return module.composite.encode(values, channels)[:, :channels].mean(1).nan_to_num()

    cameras = [scene.train.frames[i] for i in evenly_spread(len(scene.train), VIEWS)]
    looks = torch.stack([emitted(seen_at(frame, middle)) for frame in cameras])
    to_unit, unit = _scale(scene, module.modality)
    spread = (looks[..., :channels] - looks[..., :channels].mean(0)).mean(-1) * to_unit
    tolerance = TOLERANCE_C if unit else TOLERANCE_UNIT
    left_out = []
    if spread.abs().max() > tolerance / 5:
        mean, worst = looks.mean(0), 0.0
        for i in evenly_spread(len(scene.train), JUDGED):
            off = (emitted(seen_at(scene.train.frames[i], middle)) - mean)[:, :channels].mean(1) * to_unit
            worst = max(worst, float(off.abs().max()))
        left_out.append(
            f"What a Gaussian sends depends on the view: baked, whichever way it is looked at, is the mean of what it sends to "
            f"{len(cameras)} training cameras ({', '.join(frame.name for frame in cameras)}). Single ones differ from it by "
            f"{spread.square().mean().sqrt():.2g} {unit} (root mean square), any training camera by {worst:.2g} {unit} at worst; "
            "from where none looked it may be more. src/render.py shows what each direction gets."
        )
    else:
        cameras = cameras[:1]
    moved = _displacement(module, seen_at, first, span, kept)
    if moved > 0:
        left_out.append(
            f"The model moves its Gaussians over time, by up to {moved:.2g} of the scene's extent: shown are their places in "
            "the middle of the record."
        )

    def camera(time_s: float | None, ids: Tensor | None = None) -> Tensor:
        return blended(torch.stack([emitted(seen_at(frame, time_s), ids) for frame in cameras]).mean(0))

    slope = _slope(blended, to_unit, channels)
    surface = _surface(module, blended, kept) if span is not None else None
    clipped = surface is not None and _alike(_inside(surface), camera, span, tolerance / slope)
    sent = surface if clipped else camera
    record = () if scene.weather is None else tuple(scene.weather.times_s.tolist())
    bends = record if "weather" in module.thermal.needs else ()
    work = WORK * (RECALLED if bends else 1) / (max(module.thermal.cost, 1) * len(cameras))
    most = int(min(BENDS if bends else TIMES, max(FEW_TIMES, work / min(len(kept), EXAMINED))))
    curves = int(min(CURVES, max(FEW_CURVES, work / (MOMENTS * max(len(kept), 1)))))

    def layer(name: str, label: str, values_at: ValuesAt, clipped: bool = False) -> Layer:
        return _layer(name, label, values_at, len(kept), span, tolerance / slope, slope, most, curves, bends, clipped)

    layers = [layer("camera", "as seen", sent, clipped)]
    if surface is not None and not clipped and not _alike(*map(_inside, (surface, camera)), span, tolerance / slope):
        layers.append(layer("surface", "of the surface", surface))
    for part in module.thermal.removable:

        def without(time_s: float | None, ids: Tensor | None = None, part: str = part) -> Tensor:
            with module.thermal.without(part):
                return camera(time_s, ids)

        if not _alike(without, camera, span, tolerance / slope):
            label = f"without {part.replace('_', ' ')}"
            layers.append(layer(f"without {part}", label, without))
    if scene.truth is not None and span is not None and scene.thermal_range is not None:
        truth = _truth(scene, means[kept].cpu(), blended)
        most, aim = BENDS if record else TIMES, tolerance / slope * (COARSER if len(kept) > MANY else 1)
        layers.append(_layer("truth", "truth", truth, len(kept), span, aim, slope, most, CURVES, record, False))
    ends = _ends(layers, module.background[0].item())
    table = _table(module, scene, ends, channels)
    colours, colour_opacities = _colours(module, looks.mean(0), opacities[:, kept])
    attributes = module.attributes(seen_at(first, middle))
    return Snapshot(
        means[kept].float().cpu(),
        torch.nn.functional.normalize(quats[kept].float(), dim=1).cpu(),
        scales[kept].float().cpu(),
        opacities[0, kept].float().cpu(),
        layers,
        module.background[0].item(),
        table,
        ends,
        unit,
        (scene.thermal_range.min_c, scene.thermal_range.max_c) if unit else (0.0, 1.0),
        colours,
        colour_opacities,
        {name: values[kept].float().cpu() for name, values in attributes.items()},
        left_out,
        None if span is None else span[0],
        None if span is None else span[1],
    )


def span_of(scene: SceneData) -> tuple[float, float] | None:
    """First and last moment of all views; None without times or where all are the same."""
    if "time" not in scene.metadata:
        return None
    times = [frame.time_s for frame in scene.frames if frame.time_s is not None]
    return (min(times), max(times)) if max(times) > min(times) else None


def _scale(scene: SceneData, modality: str) -> tuple[float, str]:
    """What an image value of 1 is in the unit of the scene, and that unit."""
    bounds = scene.range_of(modality)
    return (1.0, "") if bounds is None else (bounds.span_k, "°C")


def _slope(blended: Callable[[Tensor], Tensor], to_unit: float, channels: int) -> float:
    """Largest change of the image, in the scene's unit, for one of a blended value."""
    values = torch.linspace(0, 1, TABLE, dtype=torch.float64)
    steps = blended(values[:, None].expand(-1, channels)).diff()
    return to_unit / (TABLE - 1) / steps.min().item()


def _inside(values_at: ValuesAt) -> ValuesAt:
    """A quantity where the image can show it."""
    return lambda time, ids=None: values_at(time, ids).clamp(0, 1)


def _alike(one: ValuesAt, other: ValuesAt, span: tuple[float, float] | None, tolerance: float) -> bool:
    """Whether two quantities are the same at some moments, to a tenth of the tolerance."""
    if span is None:
        return bool((one(None) - other(None)).abs().max() <= 0.1 * tolerance)
    moments = (span[0] + share * (span[1] - span[0]) for share in (0.0, 0.37, 0.5, 0.81, 1.0))
    return all((one(moment) - other(moment)).abs().max() <= 0.1 * tolerance for moment in moments)


def _layer(
    name: str,
    label: str,
    values_at: ValuesAt,
    count: int,
    span: tuple[float, float] | None,
    tolerance: float,
    slope: float,
    most_times: int,
    most_curves: int,
    bends: Sequence[float],
    clipped: bool,
) -> Layer:
    if span is None:
        basis = constant_basis(values_at(None, None).cpu())
    else:
        basis = time_basis(values_at, count, *span, tolerance, most_times, most_curves, bends, clipped)
    return Layer(name, label, basis, basis.worst * slope, tolerance * slope, clipped)


def _surface(module: Any, blended: Callable, kept: Tensor) -> ValuesAt | None:
    """Blended values of the temperature of the surface, where the model tells one."""
    scene = module.scene
    if scene.range_of(module.modality) is None or "time" not in scene.metadata:
        return None
    if module.thermal.temperature(module.splats, scene.record[0]) is None:
        return None
    lowest, span = kelvin(scene.thermal_range.min_c), scene.thermal_range.span_k

    def surface(time_s: float, ids: Tensor | None = None) -> Tensor:
        wanted = kept if ids is None else kept[ids]
        units = (module.thermal.temperature(module.splats, time_s, wanted) - lowest) / span
        return blended(units[:, None])

    return surface


def _truth(scene: SceneData, points: Tensor, blended: Callable) -> ValuesAt:
    """Blended values of the true temperatures at points [N, 3]."""

    def truth(time_s: float, ids: Tensor | None = None) -> Tensor:
        wanted = points if ids is None else points[ids]
        celsius = scene.truth(wanted, torch.tensor([time_s], dtype=torch.float64))[:, :1]
        return blended(scene.thermal_range.to_unit(celsius).float())

    return truth


def _ends(layers: list[Layer], background: float) -> tuple[float, float]:
    """Range of blended values that a pixel of any layer can have."""
    low, high = min(0.0, background), max(1.0, background)
    for layer in layers:
        basis = layer.basis
        reach = (basis.coefficients.abs() @ basis.curves.abs()).amax(1) if basis.rank else torch.zeros(1)
        low = min(low, (basis.offsets - reach).min().item())
        high = max(high, (basis.offsets + reach).max().item())
    return low, high


def _table(module: Any, scene: SceneData, ends: tuple[float, float], channels: int) -> Tensor:
    values = torch.linspace(*ends, TABLE, dtype=torch.float64)[:, None].expand(-1, channels)
    shown = module.composite.decode(values, channels)[:, 0]
    bounds = scene.range_of(module.modality)
    return (shown if bounds is None else bounds.to_celsius(shown)).float()


def _colours(module: Any, emitted: Tensor, opacities: Tensor) -> tuple[Tensor | None, Tensor | None]:
    """Colours [N, 3] of the visible image and their opacities [N], where the model has them."""
    thermal, start = module.thermal, 0
    for place, (name, count) in enumerate(
        zip((thermal.modality, *thermal.companions), thermal.modality_channels, strict=True)
    ):
        if count == 3 and (name == "rgb" or place == 0):
            own = opacities[0 if thermal.shared_opacity else place]
            return emitted[:, start : start + 3].clamp(0, 1).float().cpu(), own.float().cpu()
        start += count
    return None, None


def _displacement(
    module: Any, seen_at: Callable, first: Frame, span: tuple[float, float] | None, kept: Tensor
) -> float:
    """How far a Gaussian moves over the span at most, in extents of the scene."""
    if span is None:
        return 0.0
    places = [module.shapes(seen_at(first, moment))[0][kept] for moment in span]
    moved = (places[1] - places[0]).norm(dim=1)
    return float(moved.max()) / module.scene.extent if len(moved) else 0.0
