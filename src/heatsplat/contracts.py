"""The nouns that every package of heatsplat shares: cameras, views, scenes, ranges and what a renderer returns.

Conventions, once for all of them (docs/conventions.md has the page):

* OpenCV camera axes: x right, y down, z forward. ``viewmat`` maps world to camera.
* Pixel centres lie at +0.5, so the centre of the top-left pixel is (0.5, 0.5).
* Images are [H, W, C] float32 in [0, 1]; a ``ThermalRange`` says which temperatures 0 and 1 stand for.
* Time is float64 seconds since the first training frame of the scene. Physics is in kelvin, files and metrics in °C.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from operator import index
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

# Also under this name, for packages that need torch anyway; what must start without it imports heatsplat.errors.
from heatsplat.errors import (  # noqa: F401
    SceneError,
    as_written,
    check_count,
    check_numbers,
    check_option,
    counted,
    is_number,
    number_in,
    rounded,
    table_lines,
    text_in,
)

SHARE_OF_RANGE = "share of the image's range"  # unit of a course in image units
AT_ONE_PLACE = 1e-3  # radius of cameras in distances from what they see, below which it moves by about a pixel at most
SORTED = 1 << 24  # values of which torch.quantile finds quantiles; it refuses more


@dataclass(frozen=True)
class Course:
    """How something that a whole scene or its camera has in common changes over the record.

    Args:
        name: what it is, in words for a title.
        times_s: seconds since the first training frame, increasing.
        values: at these times.
        unit: of the values; SHARE_OF_RANGE for differences of image values.
    """

    name: str
    times_s: Sequence[float]
    values: Sequence[float]
    unit: str


@dataclass(frozen=True)
class ThermalRange:
    """The temperatures that image values 0 and 1 stand for; linear between them, in °C."""

    min_c: float
    max_c: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.min_c) and math.isfinite(self.max_c) and self.min_c < self.max_c):
            raise SceneError(
                f"thermal range {self.min_c} .. {self.max_c} °C is not a range: the minimum must be finite and below "
                "the maximum. Check the bounds file of the scene."
            )

    @property
    def span_k(self) -> float:
        """Width of the range in kelvin."""
        return self.max_c - self.min_c

    def to_celsius(self, unit: Any) -> Any:
        """Temperatures in °C of image values (0 is ``min_c``, 1 is ``max_c``); any shape, tensor, array or number."""
        return self.min_c + unit * self.span_k

    def to_unit(self, celsius: Any) -> Any:
        """Image values of temperatures in °C; values outside [0, 1] are kept."""
        return (celsius - self.min_c) / self.span_k


@dataclass(frozen=True)
class Camera:
    """A pinhole camera without distortion (images are undistorted when they are loaded).

    Args:
        viewmat: world-to-camera matrix [4, 4], OpenCV axes; kept as a float64 tensor.
        K: intrinsics [3, 3] in pixels, without skew; likewise. The principal point counts from the corner of the image.
        width, height: image size in pixels.

    Raises:
        SceneError: a shape or size is none of a camera, a number is NaN or infinite, or K has skew.
    """

    viewmat: Tensor
    K: Tensor
    width: int
    height: int

    def __post_init__(self) -> None:
        for name, shape in (("viewmat", (4, 4)), ("K", (3, 3))):
            matrix = torch.as_tensor(getattr(self, name), dtype=torch.float64)
            if tuple(matrix.shape) != shape:
                raise SceneError(f"camera needs viewmat [4, 4] and K [3, 3], got {name} {list(matrix.shape)}")
            if not bool(matrix.isfinite().all()):
                raise SceneError(f"{name} of a camera has NaN or infinite values: {matrix.tolist()}")
            object.__setattr__(self, name, matrix)
        (_, skew, _), (below, _, _), last = self.K.tolist()
        if skew or below or last != [0.0, 0.0, 1.0]:
            raise SceneError(
                f"K of a camera must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], without skew, got {self.K.tolist()}; undistort "
                "the images to such a camera"
            )
        try:
            size = index(self.width), index(self.height)
        except TypeError as error:
            raise SceneError(
                f"size of a camera must be whole numbers of pixels, got {self.width} x {self.height}"
            ) from error
        if min(size) < 1:
            raise SceneError(f"camera has no pixels: {self.width} x {self.height}")

    @property
    def center(self) -> Tensor:
        """Position of the camera in the world, [3] float64."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel coordinates [n, 2] and depths [n] of world points [n, 3], float64, on the device of the points; where the
        depth is not positive they lie behind the camera and the pixel means nothing."""
        viewmat, K = self.viewmat.to(points.device), self.K.to(points.device)
        local = points.to(viewmat) @ viewmat[:3, :3].T + viewmat[:3, 3]
        return (local @ K.T)[:, :2] / local[:, 2:].clamp_min(1e-12), local[:, 2]

    def inside(self, pixels: Tensor, depths: Tensor, margin: float = 0.0) -> Tensor:
        """Which points lie in the image, [n] bool, by what ``project`` says of them: before the camera, and at least ``margin``
        pixels from the border."""
        size = pixels.new_tensor([self.width, self.height])
        return (depths > 0) & (pixels >= margin).all(1) & (pixels < size - margin).all(1)

    def resized(self, width: int, height: int) -> Camera:
        """The same camera on a grid of ``width`` x ``height`` pixels; intrinsics scale by the actual pixel counts."""
        scale = torch.tensor([width / self.width, height / self.height, 1.0], dtype=torch.float64)
        return Camera(self.viewmat, self.K * scale[:, None], width, height)

    def within(self, longest: int) -> Camera:
        """The same view with at most ``longest`` pixels on its longer side."""
        shrink = max(1.0, max(self.width, self.height) / longest)
        return self.resized(max(1, round(self.width / shrink)), max(1, round(self.height / shrink)))


@dataclass(frozen=True)
class Environment:
    """Weather at one moment. Every value may be missing (None); a thermal model names what it needs."""

    air_c: float | None = None
    wind_m_s: float | None = None
    humidity_percent: float | None = None
    irradiance_w_m2: float | None = None
    pressure_hpa: float | None = None


WEATHER_COLUMNS = ("air_c", "wind_m_s", "humidity_percent", "irradiance_w_m2", "pressure_hpa")
WEATHER_DERIVED = ("direct_w_m2", "diffuse_w_m2", "clouds", "sun")  # series that follow from these and the place
RAIN = "rain_mm_h"  # a series that some records have, and that belongs to no moment: water stays


@dataclass(frozen=True)
class Weather:
    """The weather over a scene's record: what drives its temperature. Every series is linear between its samples.

    **Convention:** seconds since the first training frame, so a record may begin before 0; directions are unit vectors
    in the world's axes. Night is exactly zero in ``direct_w_m2`` and ``diffuse_w_m2``.

    Args:
        times_s: [T] float64, strictly increasing.
        air_c: air temperature in °C, [T] float64, or None (as every further series) when the record lacks it.
        wind_m_s: wind speed, 0 or more.
        humidity_percent: relative humidity, 0 to 100.
        irradiance_w_m2: irradiance on a horizontal surface by sun and sky (global horizontal), 0 or more.
        pressure_hpa: air pressure.
        direct_w_m2: irradiance by the sun alone on a surface that faces it (direct normal).
        diffuse_w_m2: irradiance by the sky alone on a horizontal surface (diffuse horizontal).
        clouds: share of the clear sky's light that clouds take over an hour, 0 to 1; by night from cover that was recorded, or
            linear between dusk and dawn.
        rain_mm_h: rain, 0 or more; 1 mm is 1 kg of water a square metre.
        sun: [T, 3] direction towards the sun, below the horizon too.
        up: [3] direction away from the ground.
        notes: what the reader found, left out and assumed, for the report.
    """

    times_s: Tensor
    air_c: Tensor | None = None
    wind_m_s: Tensor | None = None
    humidity_percent: Tensor | None = None
    irradiance_w_m2: Tensor | None = None
    pressure_hpa: Tensor | None = None
    direct_w_m2: Tensor | None = None
    diffuse_w_m2: Tensor | None = None
    clouds: Tensor | None = None
    rain_mm_h: Tensor | None = None
    sun: Tensor | None = None
    up: Tensor = field(default_factory=lambda: torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64))
    notes: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        count = len(self.times_s)
        if self.times_s.dtype != torch.float64 or count < 2 or not bool((self.times_s.diff() > 0).all()):
            raise SceneError("weather needs two or more samples at strictly increasing times, as float64 seconds")
        for name in (*WEATHER_COLUMNS, *WEATHER_DERIVED, RAIN):
            series = getattr(self, name)
            if series is not None and (len(series) != count or not bool(series.isfinite().all())):
                raise SceneError(f"weather.{name} must hold {count} finite samples, as many as weather.times_s")

    def since(self, zero_s: float) -> Weather:
        """The weather with ``zero_s`` of its clock as its new second 0; its notes say which moment that is."""
        notes = dict(self.notes)
        key = "utc_at_zero_s" if "utc_at_zero_s" in notes else "clock_at_zero_s"
        notes[key] = notes.get(key, 0.0) + zero_s
        return replace(self, times_s=self.times_s - zero_s, notes=notes)

    def at(self, time_s: float) -> Environment:
        """The weather at a moment. Raises SceneError where the record does not reach it."""
        times = self._moments
        if not times[0] <= time_s <= times[-1]:
            raise SceneError(
                f"there is no weather for second {time_s:.6g}: the record runs from {times[0]:.6g} to {times[-1]:.6g} s after "
                "the first training frame. Give a record that covers every frame."
            )
        after, share = self.between(time_s)
        columns = {name: getattr(self, name) for name in WEATHER_COLUMNS}
        return Environment(
            **{
                name: series[after - 1].item() * (1 - share) + series[after].item() * share
                for name, series in columns.items()
                if series is not None
            }
        )

    def between(self, time_s: float) -> tuple[int, float]:
        """The sample at or after a moment, never the first, and the share of the way to it from the one before."""
        times = self._moments
        after = min(max(bisect_left(times, time_s), 1), len(times) - 1)
        return after, (time_s - times[after - 1]) / (times[after] - times[after - 1])

    @cached_property
    def _moments(self) -> list[float]:
        """``times_s`` as numbers: every step of a run asks for moments, for which tensors of one number are slow."""
        return self.times_s.tolist()


@dataclass(frozen=True)
class Frame:
    """What is known of one image without its pixels.

    Args:
        name: file name, for messages and result tables.
        frame_id: index of the frame in the whole scene (all splits), unique.
        camera: where it was taken from.
        time_s: float64 seconds since the first training frame, or None.
        environment: weather at that time, or None.
    """

    name: str
    frame_id: int
    camera: Camera
    time_s: float | None = None
    environment: Environment | None = None


@dataclass(frozen=True)
class View:
    """One image with its frame: what one training step sees.

    Args:
        frame: name, id, camera and time.
        thermal: [H, W, C] float32 in [0, 1], C = 1 (3 only for pseudo-colour data, which has no temperature); or None.
        rgb: [H, W, 3] float32 in [0, 1], or None.
        mask: [H, W] bool, True where a pixel counts; None means that all do.
        clean: [H, W, C] what a camera without flaws and noise would have recorded, where that is known (synthetic
            scenes); nothing trains on it.
        ends: [H, W] int8 of the thermal image: 1 where it was cut off at its warm end and the truth may lie above its value, -1
            likewise at its cold end, 0 where the value is one; None means that all are.
    """

    frame: Frame
    thermal: Tensor | None = None
    rgb: Tensor | None = None
    mask: Tensor | None = None
    clean: Tensor | None = None
    ends: Tensor | None = None

    @property
    def camera(self) -> Camera:
        return self.frame.camera

    @property
    def time_s(self) -> float | None:
        return self.frame.time_s

    @property
    def counts(self) -> bool:
        """Whether any of its pixels counts."""
        return self.mask is None or bool(self.mask.any())

    @property
    def known(self) -> Tensor | None:
        """Which pixels [H, W] bool count and have a thermal value, and no mere bound of one; None means that all do."""
        if self.ends is None:
            return self.mask
        return self.ends == 0 if self.mask is None else self.mask & (self.ends == 0)

    def image(self, modality: str) -> Tensor:
        """The image of a modality ("thermal" or "rgb"), [H, W, C]; "clean" is the thermal image where none is known.

        Raises:
            SceneError: the view has none.
        """
        image = self.thermal if modality == "clean" and self.clean is None else getattr(self, modality, None)
        if image is None:
            raise SceneError(f"view {self.frame.name} has no {modality} image; choose a method or data set that fits")
        return image

    def to(self, device: torch.device | str, dtype: torch.dtype | None = None) -> View:
        """The same view with its images on ``device`` (cameras stay on the CPU; renderers move them), as ``dtype`` if given."""
        images = {
            key: image
            for key in ("thermal", "rgb", "mask", "clean", "ends")
            if (image := getattr(self, key)) is not None
        }
        moved = {
            key: image.to(device, dtype if image.is_floating_point() else None, non_blocking=True)
            for key, image in images.items()
        }
        return self if all(moved[key] is images[key] for key in images) else replace(self, **moved)


class ViewSet(Sequence[View]):
    """Frames whose pixels are decoded when asked for, so that a scene costs its stored integers and no more.

    Args:
        frames: what is known without pixels.
        decode: function from a position in ``frames`` to the View.
    """

    def __init__(self, frames: Sequence[Frame], decode: Callable[[int], View]) -> None:
        self.frames = tuple(frames)
        self._decode = decode

    def __repr__(self) -> str:
        return f"ViewSet of {counted(len(self), 'view')}"

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> View:  # type: ignore[override]
        if isinstance(index, slice):
            raise TypeError("take a subset of views with .subset(positions)")
        if not -len(self) <= index < len(self):
            raise IndexError(index)
        return self._decode(index % len(self))

    def __iter__(self) -> Iterator[View]:
        return (self[i] for i in range(len(self)))

    def subset(self, positions: Sequence[int]) -> ViewSet:
        """The views at ``positions``, in that order."""
        positions = list(positions)
        return ViewSet([self.frames[i] for i in positions], lambda i: self._decode(positions[i]))

    @property
    def times_s(self) -> list[float | None]:
        return [frame.time_s for frame in self.frames]


@dataclass(frozen=True)
class SceneData:
    """Everything a loader found out about a scene, in heatsplat's conventions.

    Args:
        name: scene name, used for the run's folder.
        train, val, test: views. ``val`` draws curves during training and selects nothing.
        points: [P, 3] float32 points of the scene.
        point_colors: [P, 3] float32 in [0, 1], or None.
        thermal_range: bounds in °C, or None when image values are no temperatures.
        ambient_c: temperature of the surroundings in °C, or None.
        metres_per_unit: scale of the world, or None when unknown.
        weather: the weather over the record, or None. Frames then carry its values at their time, too.
        labels: [P] int64 class of each point (land cover), or None.
        point_features: [P, D] float32 features of each point that a file gives, or None.
        notes: what the loader found and assumed, for the report: name -> value or sentence.
        probes: scene points [n, 3] whose temperature over time is drawn, or None to let the training choose.
        truth: function (points [n, 3], times_s [F]) -> °C [n, F] on synthetic scenes, or None.
        true_attributes: function (points [n, 3]) -> properties of the surface there by name with unit, each [n], on
            synthetic scenes, or None.
        positions: table of where the cameras stood on the earth (``export.place``), or None.
        reduced_by: kernel by which the data module made training images small (``data.degrade``), or None.
    """

    name: str
    train: ViewSet
    val: ViewSet
    test: ViewSet
    points: Tensor
    point_colors: Tensor | None = None
    thermal_range: ThermalRange | None = None
    ambient_c: float | None = None
    metres_per_unit: float | None = None
    weather: Weather | None = None
    labels: Tensor | None = None
    point_features: Tensor | None = None
    notes: dict[str, Any] = field(default_factory=dict)
    probes: Tensor | None = None
    truth: Callable[[Tensor, Tensor], Tensor] | None = None
    true_attributes: Callable[[Tensor], dict[str, Tensor]] | None = None
    positions: Path | None = None
    reduced_by: str | None = None

    @property
    def box(self) -> tuple[Tensor, Tensor]:
        """Lowest and highest corner [3] of the box that holds the points but for a hundredth at each end of every axis."""
        low, high = quantile(self.points.float(), torch.tensor([0.01, 0.99]))
        return low, high

    @property
    def bulk(self) -> tuple[Tensor, float]:
        """Centre [3] and longest edge of ``box``."""
        low, high = self.box
        return (low + high) / 2, max((high - low).max().item(), 1e-12)

    @property
    def origin(self) -> Tensor:
        """[3] float64 place in the data set from which coordinates count, where its own are too large for float32; else 0."""
        return torch.tensor(self.notes.get("origin", (0.0, 0.0, 0.0)), dtype=torch.float64)

    @property
    def clock_at_zero_s(self) -> float | None:
        """Second 0 of the record in seconds since 1970, by the clock of the weather or else of the camera; None where none is
        known."""
        if self.weather is not None:
            return self.weather.notes.get("utc_at_zero_s")
        return self.notes.get("clock_at_zero_s")

    @property
    def distance(self) -> float:
        """Median distance between the training cameras and the middle of the points, in world units."""
        centers = torch.stack([frame.camera.center for frame in self.train.frames])
        return (self.points.double().median(0).values - centers).norm(dim=1).median().item()

    def range_of(self, modality: str) -> ThermalRange | None:
        """The range of the images of a modality ("clean" is a thermal image, too); None where they are no temperatures."""
        return self.thermal_range if modality in ("thermal", "clean") else None

    @property
    def frames(self) -> tuple[Frame, ...]:
        """The frames of all splits, those of training first, each once though splits may share it."""
        parts = (self.train, self.val, self.test)
        return tuple({frame.frame_id: frame for part in parts for frame in part.frames}.values())

    @property
    def middle_s(self) -> float | None:
        """The time of the training view nearest to the middle of the record, in seconds; None where none has a time.

        Between images, by day where all were taken by night, a model would only predict.
        """
        times = [time_s for time_s in self.train.times_s if time_s is not None]
        if not times:
            return None
        middle_s = (min(times) + max(times)) / 2
        return min(times, key=lambda time_s: abs(time_s - middle_s))

    @property
    def record(self) -> tuple[float, float]:
        """First training time in seconds and the span from there to the last; a span of 1 where all are the same.

        Raises:
            SceneError: a training view has no time.
        """
        if self._ends is None:
            raise SceneError(f"scene '{self.name}' has training views without a time, so it has no record")
        first, last = self._ends
        return first, last - first if last > first else 1.0

    def beyond_record(self, time_s: float | None) -> float:
        """Seconds between a moment and the nearest one of the training record; 0 within it, or without times."""
        if time_s is None or self._ends is None:
            return 0.0
        first, last = self._ends
        return max(first - time_s, time_s - last, 0.0)

    @cached_property
    def _ends(self) -> tuple[float, float] | None:
        """First and last time of the training record, which long shots ask for at every frame; None without times."""
        return (min(self.train.times_s), max(self.train.times_s)) if "time" in self.metadata else None

    @cached_property
    def extent(self) -> float:
        """1.1 times the radius of the training cameras about their mean: the length unit of learning rates (3DGS).

        Where they stand at one place, as on a tripod, it is their distance from the middle of the points: neither rounding nor
        the unit of the world is a length of the scene.
        """
        centers = torch.stack([frame.camera.center for frame in self.train.frames])
        radius = (centers - centers.mean(0)).norm(dim=1).max().item()
        distance = self.distance if len(self.points) else 0.0
        return 1.1 * radius if radius > AT_ONE_PLACE * distance else distance or 1.0

    @property
    def metadata(self) -> frozenset[str]:
        """Names of the metadata that the scene has, in the vocabulary of ``ThermalModel.needs``."""
        return frozenset(name for name, has in METADATA.items() if has(self))


# What a scene may have beside its images, and whether one has it.
METADATA: dict[str, Callable[[SceneData], bool]] = {
    "time": lambda scene: len(scene.train) > 0 and all(time is not None for time in scene.train.times_s),
    "thermal_range": lambda scene: scene.thermal_range is not None,
    "ambient": lambda scene: scene.ambient_c is not None,
    "metres": lambda scene: scene.metres_per_unit is not None,
    "weather": lambda scene: scene.weather is not None,
    "labels": lambda scene: scene.labels is not None,
    "point_features": lambda scene: scene.point_features is not None,
}


@dataclass(frozen=True)
class WeightedSums:
    """Sums over the pixels of maps, weighted by the blending weights of each Gaussian, as gradients of zeros.

    Add ``(image * maps).sum()`` to the loss, maps [H, W, S] being constant: it adds nothing to the value and to no other
    gradient, and the backward pass leaves in ``sums`` what each visible Gaussian has of each map.

    Args:
        image: [H, W, S] zeros with a gradient.
        rows: [n, S] zeros, a row for each of ``meta["visible_ids"]``.
    """

    image: Tensor
    rows: Tensor

    @property
    def sums(self) -> Tensor | None:
        """Σ_p maps[p] w[p, i], [n, S], with w = T α of the first modality; None before the backward pass."""
        return self.rows.grad


@dataclass(frozen=True)
class RenderOutput:
    """What a renderer returns, for M modalities (opacity sets) and C channels.

    Args:
        features: [H, W, C] composited features, background included.
        alpha: [M, H, W] accumulated opacity of each modality.
        depth: [H, W] accumulated depth of the first modality (sum of weight times camera z; divide by alpha for the
            expected depth), or None when it was not asked for.
        meta: "means2d" [N, 2] in pixels, a tensor whose .grad is filled by the backward pass (and whose .absgrad is,
            with absgrad=True: sums over pixels and modalities); "radii" [N, 2] int32 extents in pixels, 0 where a
            Gaussian is not seen; "visible_ids" [n] int64. Where rows of splats become several Gaussians, training adds
            their "opacities" [M, N] as rendered, and "rows_in_view", bool. Empty for fields, which have no Gaussians.
        weighted: sums of maps over pixels, where they were asked for.
        signed: [H, W] composited ``signs`` of the first modality, where they were given.
    """

    features: Tensor
    alpha: Tensor
    depth: Tensor | None
    meta: dict[str, Tensor]
    weighted: WeightedSums | None = None
    signed: Tensor | None = None

    @property
    def seen_depth(self) -> Tensor | None:
        """Mean depth [H, W] of what is seen in the first modality, a constant; infinite where nothing is, None without."""
        if self.depth is None:
            return None
        alpha = self.alpha[0].detach()
        return torch.where(alpha > 1e-3, self.depth.detach() / alpha, torch.inf)


def quantile(values: Tensor, shares: float | Tensor) -> Tensor:
    """Quantiles [..., *] of values [n, *] along their first axis, as of ``torch.quantile``, which takes no more than ``SORTED``.

    Args:
        values: floating point, at least one; pixels and points may be many more.
        shares: one, or [...] of the type of the values, from 0 to 1.
    """
    if len(values) <= SORTED:
        return torch.quantile(values, shares, dim=0)
    places = torch.as_tensor(shares, dtype=torch.float64, device=values.device) * (len(values) - 1)
    ordered = values.sort(dim=0).values
    below = places.long()
    between = (places - below).to(values).reshape((*places.shape, *[1] * (values.ndim - 1)))
    found = torch.lerp(ordered[below], ordered[(below + 1).clamp(max=len(values) - 1)], between)
    return torch.where(ordered[-1].isnan(), torch.nan, found)  # where NaN comes to lie


def evenly_spread(count: int, limit: int) -> list[int]:
    """At most ``limit`` positions out of ``count``, evenly spread, first and last among them; the first alone for one."""
    if count <= limit:
        return list(range(count))
    return [round(i * (count - 1) / max(limit - 1, 1)) for i in range(limit)]
