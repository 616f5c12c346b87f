"""From raw records to a SceneData: the one place where time gets its origin, and images their grid.

A loader (one file per data set) finds files and fills ``RawFrame`` records; ``build_scene`` does everything that is the
same for all of them. A scene that never was on disk goes the same way: ``read`` may return an array from memory.
"""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from heatsplat.datamodules.bounds import MAX_CELSIUS, MIN_CELSIUS, celsius
from heatsplat.datamodules.formats.images import (
    PSEUDO_COLOUR_LEVELS,
    colour_levels,
    resized,
    resized_mask,
    split_alpha,
    to_grey,
    undistorted,
    undistorted_mask,
)
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.poses import MAX_COORDINATE, checked_pose
from heatsplat.datamodules.side_files import finite
from heatsplat.datamodules.splits import SplitRule
from torch import Tensor

from heatsplat.contracts import (
    Camera,
    Environment,
    Frame,
    SceneData,
    SceneError,
    ThermalRange,
    View,
    ViewSet,
    Weather,
    evenly_spread,
)

log = logging.getLogger(__name__)

MAX_VAL_VIEWS = 8
# Seconds: three hundred centuries, more than any clock of a recording counts.
MAX_TIME_S = 1e12


@dataclass(frozen=True)
class RawFrame:
    """One image as a loader found it, before anything is resampled, shifted or split.

    Args:
        name: file name relative to the image folder; splits and messages use it.
        viewmat: world-to-camera [4, 4] float64, OpenCV axes.
        lens: intrinsics and distortion, for whatever image size they were written down for.
        read: returns the stored thermal pixels [H, W] or [H, W, 3 or 4] (RGB, RGBA), uint8, uint16 or float32. Integers
            span their type (0 .. 255 is 0 .. 1) unless the scene has ``Counts``; float32 holds °C, NaN where unknown.
            None for a photo, which ``read_rgb`` returns.
        time_s: seconds on any clock, float64, or None.
        read_rgb: returns a visible image of the same camera, or None.
        read_mask: returns [H, W] bool for the stored thermal image, True where a pixel counts, or None.
        subset: "train" or "test" where the data set itself says so (folder, list), else None.
        environment: weather at that time, or None.
    """

    name: str
    viewmat: np.ndarray
    lens: Lens
    read: Callable[[], np.ndarray] | None
    time_s: float | None = None
    read_rgb: Callable[[], np.ndarray] | None = None
    read_mask: Callable[[], np.ndarray] | None = None
    subset: str | None = None
    environment: Environment | None = None

    def __post_init__(self) -> None:
        checked_pose(self.viewmat, f"viewmat of frame {self.name}")


@dataclass(frozen=True)
class Counts:
    """The linear map from stored numbers to temperature: °C = ``scale`` * stored + ``offset_c``."""

    scale: float
    offset_c: float

    def __post_init__(self) -> None:
        if not (0 < self.scale < math.inf and math.isfinite(self.offset_c)):
            raise SceneError(
                f"data.raw_scale must be positive (°C per count), got {self.scale}, and data.raw_offset_c finite, got "
                f"{self.offset_c}"
            )


CELSIUS = Counts(scale=1.0, offset_c=0.0)


@dataclass(frozen=True)
class _Stored:
    """Pixels of one view on their final grid, in the stored type, with what is needed to decode them."""

    frame: Frame
    thermal: np.ndarray | None
    rgb: np.ndarray | None
    mask: np.ndarray | None
    zero: float
    full: float
    channels: int

    def decode(self) -> View:
        rgb = None
        if self.rgb is not None:
            full = np.float32(np.iinfo(self.rgb.dtype).max)
            rgb = torch.from_numpy(np.divide(self.rgb, full, dtype=np.float32))
        mask = None if self.mask is None else torch.from_numpy(self.mask)
        thermal = None if self.thermal is None else torch.from_numpy(self._unit(self.thermal))
        return View(frame=self.frame, thermal=thermal, rgb=rgb, mask=mask)

    def _unit(self, stored: np.ndarray) -> np.ndarray:
        # numpy, not torch: a thread pool costs more than it gains on one image, and much more on a busy machine.
        unit = np.subtract(stored, self.zero, dtype=np.float32)
        unit /= np.float32(self.full)
        np.clip(unit, 0.0, 1.0, out=unit)
        if unit.ndim == 2:
            unit = unit[..., None] if self.channels == 1 else np.repeat(unit[..., None], self.channels, axis=2)
        return unit


def build_scene(
    name: str,
    frames: Sequence[RawFrame],
    points: np.ndarray,
    *,
    split: SplitRule,
    point_colors: np.ndarray | None = None,
    thermal_range: ThermalRange | None = None,
    counts: Counts | None = None,
    ambient_c: float | None = None,
    metres_per_unit: float | None = None,
    weather: Weather | None = None,
    labels: np.ndarray | None = None,
    point_features: np.ndarray | None = None,
    downscale: float = 1.0,
    thermal_channels: int = 1,
    alpha_mask: bool = False,
    notes: Mapping[str, Any] | None = None,
    probes: np.ndarray | None = None,
    truth: Callable[[Tensor, Tensor], Tensor] | None = None,
    true_attributes: Callable[[Tensor], dict[str, Tensor]] | None = None,
) -> SceneData:
    """The scene of raw frames and points, in heatsplat's conventions; every assumption stands in its notes.

    In this order: sort by time (by name without times), split, subtract the time of the first training frame, subtract
    a float64 origin where float32 could not hold the coordinates, undistort, downscale, keep the stored integer type.

    Args:
        name: scene name.
        frames: at least one training and one test frame under ``split``.
        points: [P, 3] in the world of the frames' ``viewmat``, at least 4 finite ones.
        split: which frames are held out.
        point_colors: [P, 3] in [0, 1], or None.
        thermal_range: bounds in °C; with ``counts`` and without bounds they are taken from the training images.
        counts: map from stored numbers to °C, for raw sensor data; None when integers span their type.
        ambient_c: temperature of the surroundings, or None.
        metres_per_unit: scale of the world, or None.
        weather: the weather on the clock of ``frames``, or None; frames without an environment get theirs from it.
        labels: [P] class of each point, or None.
        point_features: [P, D] features of each point, or None.
        downscale: factor >= 1; images become round(W / d) x round(H / d) by area averages.
        thermal_channels: 1, or 3 to keep pseudo-colour (which has no temperature: the range is dropped).
        alpha_mask: True to leave out pixels whose alpha is below one half; otherwise alpha is ignored.
        notes: what the loader found, kept and added to.
        probes: [n, 3] in the same world as ``points``, or None.
        truth: function (points [n, 3], times [F]) -> °C [n, F] in the world and on the clock of ``frames``, or None.
        true_attributes: function (points [n, 3]) -> properties by name, each [n], in the same world, or None.

    Raises:
        SceneError: something cannot be used as it is.
    """
    notes = dict(notes or {})
    if not frames:
        raise SceneError(f"scene {name} has no frames")
    if photos := sum(frame.read is None for frame in frames):
        if photos < len(frames):
            raise SceneError(f"scene {name} has thermal images of {len(frames) - photos} frames and none of {photos}")
        notes["photos"] = "visible images only: an RGB scene, without thermal images and temperatures"
        thermal_range = None
    if not downscale >= 1:
        raise SceneError(f"data.downscale must be 1 or larger, got {downscale}")
    if thermal_channels not in (1, 3):
        raise SceneError(f"data.thermal_channels must be 1 or 3, got {thermal_channels}")

    if ambient_c is not None:
        ambient_c = celsius(ambient_c, f"ambient_c of scene {name}")
    if metres_per_unit is not None:
        metres_per_unit = finite(metres_per_unit, f"metres_per_unit of scene {name}")
        if not metres_per_unit > 0:
            raise SceneError(f"metres_per_unit of scene {name} is {metres_per_unit}; metres of one unit, above 0")

    frames, times, time_notes = _in_order(frames)
    notes |= time_notes
    order = list(range(len(frames)))
    train, test = split([f.name for f in frames], order, [f.subset for f in frames])
    train, test = sorted(train), sorted(test)
    first_s = times[train[0]] if times else None
    val = [test[i] for i in evenly_spread(len(test), MAX_VAL_VIEWS)]
    notes |= {
        "split": split.rule,
        "train_views": len(train),
        "test_views": len(test),
        "val_views": f"{len(val)} of the test views, evenly spaced; they draw curves and select nothing",
    }
    if left_out := len(frames) - len(set(train) | set(test)):
        notes["split_left_out"] = f"{left_out} frames are in neither list and are not used"

    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    kept = (np.abs(points) <= MAX_COORDINATE).all(axis=1)
    labels = _of_points("labels", labels, kept)
    point_features = _of_points("point_features", point_features, kept)
    point_colors = _of_points("point_colors", point_colors, kept)
    points = points[kept]
    notes["points"] = len(points)
    if len(points) < len(kept):
        notes["points_dropped"] = f"{len(kept) - len(points)} points with NaN, infinite or absurdly large coordinates"
    if len(points) < 4:
        raise SceneError(
            f"scene {name} has {len(points)} finite points, at least 4 are needed to start from; "
            "check points3D in the sparse model"
        )
    if weather is not None:
        if times is None:
            raise SceneError(f"scene {name} has weather, but its frames have no times: which weather belongs to which?")
        weather = on_clock(weather, first_s)
        notes |= {f"weather_{key}": value for key, value in weather.notes.items()}
    origin = _origin_of(frames, points)
    if origin.any():
        notes["origin"] = origin.tolist()
        notes["recentred"] = "coordinates too large for float32: 'origin' (world units) was subtracted from the scene"

    used = sorted(set(train) | set(test))
    with ThreadPoolExecutor() as pool:  # decoding takes most of the time and leaves Python alone
        prepare = partial(_prepare, downscale=downscale, channels=thermal_channels, alpha_mask=alpha_mask)
        prepared = dict(zip(used, pool.map(prepare, [frames[i] for i in used]), strict=True))
    _check_equals({frames[i].name: p for i, p in prepared.items()})
    if prepared[used[0]].found["type"] == "float32" and counts is None:
        counts = CELSIUS
        notes["encoding"] = "float pixels are temperatures in °C"
    if counts and thermal_range is None:
        thermal_range = _range_of([prepared[i] for i in train], counts)
        notes["bounds_source"] = "0.1 and 99.9 percentile of the training images: none were given"
    colour = {frames[i].name: p.colour for i, p in prepared.items() if p.colour > PSEUDO_COLOUR_LEVELS}
    if colour and thermal_range is not None and thermal_channels == 1:
        raise SceneError(
            f"image {next(iter(colour))} of scene {name} is pseudo-colour (its channels differ by "
            f"{max(colour.values()):.0f} grey levels on average), so its values are no temperatures although the scene "
            "has bounds. Point the loader at grey images, or train on the colours with data.thermal_channels=3 (no °C)."
        )
    if thermal_channels == 3 and thermal_range is not None:
        thermal_range = None
        notes["bounds_ignored"] = "three thermal channels are pseudo-colour, which has no temperature"
    if colour and thermal_channels == 1:
        notes["pseudo_colour"] = f"{len(colour)} images are pseudo-colour; their luma is used and is no temperature"
    notes |= _image_notes(prepared, downscale)

    stored: dict[int, _Stored] = {}
    for i in used:
        p, raw = prepared.pop(i), frames[i]
        viewmat = raw.viewmat.astype(np.float64, copy=True)
        viewmat[:3, 3] += viewmat[:3, :3] @ origin
        camera = Camera(torch.from_numpy(viewmat), torch.from_numpy(p.lens.matrix()), p.lens.width, p.lens.height)
        time_s = None if times is None else times[i] - first_s
        environment = raw.environment
        if weather is not None and environment is None:
            environment = weather_of(raw.name, weather, time_s)
        frame = Frame(name=raw.name, frame_id=i, camera=camera, time_s=time_s, environment=environment)
        zero, full = _scaling(np.dtype(p.found["type"]), counts, thermal_range)
        stored[i] = _Stored(frame, p.thermal, p.rgb, p.mask, zero, full, thermal_channels)
    if counts:
        notes["clipped_fraction"] = _clipped_fraction(list(stored.values()))
    if thermal_range is None:
        notes["thermal_range_c"] = "none: image values are no temperatures, and errors in °C are undefined"
    else:
        notes["thermal_range_c"] = [thermal_range.min_c, thermal_range.max_c]

    def views(positions: Sequence[int]) -> ViewSet:
        items = [stored[i] for i in positions]
        return ViewSet([item.frame for item in items], lambda k: items[k].decode())

    shift = torch.from_numpy(origin)
    return SceneData(
        name=name,
        train=views(train),
        val=views(val),
        test=views(test),
        points=torch.from_numpy((points - origin).astype(np.float32)),
        point_colors=None if point_colors is None else torch.from_numpy(point_colors.astype(np.float32)),
        thermal_range=thermal_range,
        ambient_c=ambient_c,
        metres_per_unit=metres_per_unit,
        weather=weather,
        labels=None if labels is None else torch.from_numpy(labels.astype(np.int64)),
        point_features=None if point_features is None else torch.from_numpy(point_features.astype(np.float32)),
        notes=notes,
        probes=None if probes is None else torch.from_numpy((probes - origin).astype(np.float32)),
        truth=truth and (lambda where, when: truth(where + shift.to(where), when + (first_s or 0.0))),
        true_attributes=true_attributes and (lambda where: true_attributes(where + shift.to(where))),
    )


def on_clock(weather: Weather, zero_s: float) -> Weather:
    """The weather with ``zero_s`` of its clock as its new second 0; its notes say which moment that is."""
    notes = dict(weather.notes)
    key = "utc_at_zero_s" if "utc_at_zero_s" in notes else "clock_at_zero_s"
    notes[key] = notes.get(key, 0.0) + zero_s
    return replace(weather, times_s=weather.times_s - zero_s, notes=notes)


def weather_of(name: str, weather: Weather, time_s: float) -> Environment:
    """The weather at the time of a frame. Raises SceneError naming the frame where the record does not reach it."""
    try:
        return weather.at(time_s)
    except SceneError as error:
        raise SceneError(f"frame {name}: {error}") from error


def _of_points(what: str, values: np.ndarray | None, kept: np.ndarray) -> np.ndarray | None:
    """The rows of a table of points that belong to finite ones. Raises SceneError when it is of another length."""
    if values is None:
        return None
    if len(values) != len(kept):
        raise SceneError(
            f"data.{what}: there are {len(values)} rows for {len(kept)} points; one for each point of the scene is "
            "needed, in the order of the points"
        )
    return np.asarray(values)[kept]


@dataclass(frozen=True)
class _Prepared:
    thermal: np.ndarray | None
    rgb: np.ndarray | None
    mask: np.ndarray | None
    lens: Lens
    found: dict[str, Any]
    colour: float


def _prepare(frame: RawFrame, downscale: float, channels: int, alpha_mask: bool) -> _Prepared:
    """Pixels of one frame on their final grid, undistorted, with the lens that belongs to them."""
    read = frame.read or frame.read_rgb
    if read is None:
        raise SceneError(f"frame {frame.name} has neither a thermal nor a visible image")
    pixels, alpha = split_alpha(_supported(read(), frame.name))
    height, width = pixels.shape[:2]
    if frame.read is None:
        pixels, channels = _three_channels(pixels, frame.name), 3
    colour = colour_levels(pixels)
    found = {
        "size": f"{width}x{height}",
        "type": str(pixels.dtype),
        "channels": ("L" if pixels.ndim == 2 else "RGB") + ("A" if alpha is not None else ""),
        "model": frame.lens.model,
        "distorted": frame.lens.is_distorted,
        "rescaled": (frame.lens.width, frame.lens.height) != (width, height),
        "nan": 0,
        "rgb_resized": False,
    }
    mask = alpha if alpha_mask else None
    if frame.read_mask is not None:
        given = frame.read_mask()
        if given.shape != (height, width):
            raise SceneError(
                f"mask of {frame.name} is {given.shape[1]}x{given.shape[0]} but the image is {width}x{height}; "
                "masks must have the size of the stored image"
            )
        mask = given if mask is None else mask & given
    if pixels.ndim == 3 and (channels == 1 or pixels.dtype.kind == "f"):
        pixels = to_grey(pixels)
    if pixels.dtype.kind == "f":
        known = (pixels >= MIN_CELSIUS) & (pixels <= MAX_CELSIUS)
        found["nan"] = int(known.size - known.sum())
        if found["nan"]:
            if not known.any():
                raise SceneError(
                    f"image {frame.name} holds no finite pixel that is a temperature in °C; remove it from the scene"
                )
            # Any finite filling will do under the mask; the median keeps resampling well-behaved beside it.
            pixels = np.where(known, pixels, np.median(pixels[known]))
            mask = known if mask is None else mask & known
    rgb = None
    if frame.read is not None and frame.read_rgb is not None:
        rgb, _ = split_alpha(_supported(frame.read_rgb(), f"{frame.name} (visible)"))
        rgb = _three_channels(rgb, frame.name)
        found["rgb_resized"] = rgb.shape[:2] != (height, width)
        rgb = resized(rgb, width, height)
    lens = frame.lens.resized(width, height)
    if lens.is_distorted:
        pixels, mask = undistorted(pixels, lens), undistorted_mask(mask, lens)
        rgb = None if rgb is None else undistorted(rgb, lens)
    small = (max(1, round(width / downscale)), max(1, round(height / downscale)))
    pixels = resized(pixels, *small)
    rgb = None if rgb is None else np.ascontiguousarray(resized(rgb, *small))
    mask = None if mask is None else resized_mask(mask, *small)
    if mask is not None and mask.all():
        mask = None
    if frame.read is None:
        return _Prepared(None, np.ascontiguousarray(pixels), mask, lens.resized(*small), found, colour=0.0)
    return _Prepared(np.ascontiguousarray(pixels), rgb, mask, lens.resized(*small), found, colour)


def _three_channels(rgb: np.ndarray, name: str) -> np.ndarray:
    """A visible image [H, W, 3] of integers. Raises SceneError naming its frame where it is of another type."""
    if rgb.dtype.kind == "f":
        raise SceneError(f"the visible image of {name} is {rgb.dtype}; save it with 8 or 16 bits")
    return rgb if rgb.ndim == 3 else np.repeat(rgb[..., None], 3, axis=2)


def _supported(pixels: np.ndarray, name: str) -> np.ndarray:
    """The pixels as uint8, uint16 or float32. Raises SceneError for other types and shapes."""
    pixels = pixels.astype(np.float32) if pixels.dtype == np.float64 else pixels
    grey_or_colour = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] in (3, 4))
    if pixels.dtype not in (np.uint8, np.uint16, np.float32) or not grey_or_colour or pixels.size == 0:
        raise SceneError(
            f"image {name} is {pixels.dtype} {list(pixels.shape)}; images are [H, W], [H, W, 3] or [H, W, 4] of uint8, "
            "uint16 or float32 (°C)"
        )
    return pixels


def _in_order(frames: Sequence[RawFrame]) -> tuple[list[RawFrame], list[float] | None, dict[str, Any]]:
    """Frames by (time, name), their times or None, and what to note about them."""
    known = [f.time_s for f in frames if f.time_s is not None]
    if len(known) < len(frames):
        notes: dict[str, Any] = {"time": "none: only static methods apply"}
        if known:
            notes["time"] = f"none: only {len(known)} of {len(frames)} frames have a time, so no time is used"
        return sorted(frames, key=lambda f: f.name), None, notes
    frames = sorted(frames, key=lambda f: (f.time_s, f.name))
    times = [float(f.time_s) for f in frames]
    for frame, time in zip(frames, times, strict=True):
        if not abs(time) < MAX_TIME_S:
            raise SceneError(
                f"frame {frame.name} has a time that is no finite number of seconds, or absurdly large: {time}"
            )
    notes = {"duration_s": times[-1] - times[0]}
    if repeated := len(times) - len(set(times)):
        notes["duplicate_times"] = f"{repeated} frames share their time with another one; all are kept"
        log.warning("%d frames share their time with another one; all are kept", repeated)
    return frames, times, notes


def _check_equals(prepared: Mapping[str, _Prepared]) -> None:
    """Raises SceneError for an image of another type than the others, or another size than those of its camera."""
    cameras: dict[Any, list[tuple[str, _Prepared]]] = {}
    for name, p in prepared.items():
        lens = p.lens
        seen = (lens.fx / lens.width, lens.fy / lens.height, lens.cx / lens.width, lens.cy / lens.height)
        cameras.setdefault((tuple(np.round(seen, 9)), lens.distortion, lens.model), []).append((name, p))
    types = Counter(p.found["type"] for p in prepared.values())
    (most, count), *others = types.most_common()
    if others:
        odd = next(name for name, p in prepared.items() if p.found["type"] != most)
        kinds = "float images (°C) with integer images" if "float32" in types else "bit depths"
        raise SceneError(
            f"image {odd} is {prepared[odd].found['type']}, {count} others are {most}: the scene mixes {kinds}; convert "
            "them to one kind"
        )
    for frames in cameras.values():
        sizes = Counter(p.found["size"] for _, p in frames)
        most, count = sizes.most_common(1)[0]
        for name, p in frames:
            size = p.found["size"]
            if size != most and count >= 3 and (sizes[size] == 1 or p.found["rescaled"]):
                raise SceneError(
                    f"image {name} is {size}, but {count} others of the same camera are {most}; copy or export it again"
                )


def _origin_of(frames: Sequence[RawFrame], points: np.ndarray) -> np.ndarray:
    """What to subtract from all coordinates [3] float64: zero unless float32 would lose the scene's detail.

    float32 resolves 1.2e-7 of a coordinate. The rule asks for 1e-5 of the scene's size (cameras, or points if they
    spread further), which UTM coordinates of a scene of 100 m miss by a factor of 100.
    """
    centers = np.stack([-f.viewmat[:3, :3].T @ f.viewmat[:3, 3] for f in frames])
    centroid = np.median(centers, axis=0)
    radius = np.linalg.norm(centers - centroid, axis=1).max()
    spread = np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1))
    size = max(radius, spread)
    if np.linalg.norm(centroid) * np.finfo(np.float32).eps <= 1e-5 * size:
        return np.zeros(3)
    return np.round(centroid)


def _range_of(prepared: Sequence[_Prepared], counts: Counts) -> ThermalRange:
    """Bounds that hold 99.8 % of the unmasked pixels; the rest clips, so that a hot pixel does not flatten a scene."""
    # A percentile needs no more than a few million pixels.
    stride = 1 + sum(p.thermal.size for p in prepared) // 4_000_000
    values = np.concatenate([(p.thermal if p.mask is None else p.thermal[p.mask]).ravel()[::stride] for p in prepared])
    low, high = map(float, np.percentile(values, [0.1, 99.9])) if values.size else (0.0, 0.0)
    if not low < high:
        raise SceneError(f"the training images are constant ({low}), so no temperature range can be taken from them")
    return ThermalRange(counts.scale * low + counts.offset_c, counts.scale * high + counts.offset_c)


def _scaling(dtype: np.dtype, counts: Counts | None, bounds: ThermalRange | None) -> tuple[float, float]:
    """(zero, full): an image value in [0, 1] is (stored - zero) / full."""
    if counts is None or bounds is None:
        return 0.0, float(np.iinfo(dtype).max) if dtype.kind == "u" else 1.0
    return (bounds.min_c - counts.offset_c) / counts.scale, bounds.span_k / counts.scale


def _clipped_fraction(stored: Sequence[_Stored]) -> float:
    """Share of all pixels that lie outside the bounds and are clipped to them."""
    outside = sum(int(((s.thermal < s.zero) | (s.thermal > s.zero + s.full)).sum()) for s in stored)
    return outside / sum(s.thermal.size for s in stored)


def _image_notes(prepared: Mapping[int, _Prepared], downscale: float) -> dict[str, Any]:
    """What the images of a scene have in common and where they differ."""
    found = [p.found for p in prepared.values()]

    def tally(key: str) -> str:
        counted = Counter(str(f[key]) for f in found)
        return next(iter(counted)) if len(counted) == 1 else ", ".join(f"{k} ({n})" for k, n in counted.items())

    grids = Counter(f"{p.lens.width}x{p.lens.height}" for p in prepared.values())
    notes: dict[str, Any] = {
        "image_size": tally("size"),
        "pixel_type": tally("type"),
        "channels": tally("channels"),
        "camera_model": tally("model"),
        "downscale": downscale,
        "grid": ", ".join(grids),
    }
    if rescaled := sum(f["rescaled"] for f in found):
        notes["intrinsics_rescaled"] = (
            f"{rescaled} images differ in size from their camera; intrinsics follow the image"
        )
    if distorted := sum(f["distorted"] for f in found):
        notes["distortion"] = f"{distorted} images undistorted onto a pinhole of the same focal length"
    if nan := sum(f["nan"] for f in found):
        notes["nan_pixels"] = f"{nan} pixels are NaN, infinite or below absolute zero and masked"
        log.warning("%d pixels are NaN, infinite or below absolute zero and masked", nan)
    if rgb := sum(f["rgb_resized"] for f in found):
        notes["rgb_resized"] = f"{rgb} visible images resized to the thermal grid"
    if masked := [p.mask for p in prepared.values() if p.mask is not None]:
        share = sum(int((~m).sum()) for m in masked) / sum(p.lens.width * p.lens.height for p in prepared.values())
        notes["masked_fraction"] = share
    return notes
