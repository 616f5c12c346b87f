"""From raw records to a SceneData: the one place where time gets its origin, and images their grid.

A loader (one file per data set) finds files and fills a ``RawScene`` of ``RawFrame`` records; ``build_scene`` does
everything that is the same for all of them. A scene that never was on disk goes the same way: ``read`` may return an
array from memory.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import PurePosixPath
from typing import Any

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import (
    Camera,
    Frame,
    SceneData,
    SceneError,
    ThermalRange,
    View,
    ViewSet,
    counted,
    evenly_spread,
)
from heatsplat.datamodules.bounds import BOUNDS_FILE, BOUNDS_TABLE, MIN_CELSIUS, celsius, spans_told, union
from heatsplat.datamodules.formats.images import PSEUDO_COLOUR_LEVELS
from heatsplat.datamodules.formats.pseudo_colour import palette_notes
from heatsplat.datamodules.poses import MAX_COORDINATE
from heatsplat.datamodules.prepared_images import PreparedImage, check_equals, check_masks, image_notes, prepare
from heatsplat.datamodules.raw_scene import CELSIUS, Counts, RawFrame, RawScene, SceneOptions
from heatsplat.datamodules.side_files import finite
from heatsplat.datamodules.splits import ALL, every_nth
from heatsplat.datamodules.weather import weather_at_frame
from heatsplat.datamodules.weather_table import FIRST_EPOCH_S, LAST_EPOCH_S
from heatsplat.physics.defects import dead_pixels

log = logging.getLogger(__name__)

MAX_VAL_VIEWS = 8
FITTED = "scores tell how well they are fitted, not how well other views are foreseen"
# Share of the range of the training images that bounds taken from them leave at both ends, for the noise of held-out ones.
RANGE_MARGIN = 0.01
DEAD_PIXEL_FRAMES = 8  # images that dead pixels are told from
MAX_OUTSIDE = 0.95  # share of the training pixels beyond given bounds, above which nothing is left to learn


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
    ends: np.ndarray | None = None

    def decode(self) -> View:
        rgb = None
        if self.rgb is not None:
            full = np.float32(np.iinfo(self.rgb.dtype).max)
            rgb = torch.from_numpy(np.divide(self.rgb, full, dtype=np.float32))
        mask = None if self.mask is None else torch.from_numpy(self.mask)
        thermal = None if self.thermal is None else torch.from_numpy(self._unit(self.thermal))
        ends = None if self.ends is None else torch.from_numpy(self.ends)
        return View(frame=self.frame, thermal=thermal, rgb=rgb, mask=mask, ends=ends)

    def _unit(self, stored: np.ndarray) -> np.ndarray:
        # numpy, not torch: a thread pool costs more than it gains on one image, and much more on a busy machine.
        unit = np.subtract(stored, self.zero, dtype=np.float32)
        unit /= np.float32(self.full)
        np.clip(unit, 0.0, 1.0, out=unit)
        if unit.ndim == 2:
            unit = unit[..., None] if self.channels == 1 else np.repeat(unit[..., None], self.channels, axis=2)
        return unit


def build_scene(raw: RawScene, options: SceneOptions) -> SceneData:
    """The scene of raw frames and points, in heatsplat's conventions; every assumption stands in its notes.

    In this order: sort by time (by name without times), split, subtract the time of the first training frame, subtract
    a float64 origin where float32 could not hold the coordinates, undistort, downscale, keep the stored integer type.

    Raises:
        SceneError: something cannot be used as it is.
    """
    if not raw.frames:
        raise SceneError(f"scene {raw.name} has no frames")
    notes = dict(raw.notes)
    raw = _with_checked_numbers(_without_bounds_of_photos(raw, notes))
    raw = _with_range_of_spans(raw, options)
    frames, times, time_notes = _in_order(raw.frames)
    notes |= time_notes
    train, test, val = _split(frames, options, notes)
    first_s = times[train[0]] if times else None
    raw = _with_finite_points(raw, notes)
    raw = _with_weather_since(raw, first_s, notes)
    if raw.weather is None and first_s is not None and first_s >= FIRST_EPOCH_S:
        notes["clock_at_zero_s"] = first_s
    origin = _origin_of(frames, raw.points)
    if origin.any():
        notes["origin"] = origin.tolist()
        notes["recentred"] = "coordinates too large for float32: 'origin' (world units) was subtracted from the scene"

    used = sorted(set(train) | set(test))
    with ThreadPoolExecutor() as pool:  # decoding takes most of the time and leaves Python alone
        images = pool.map(partial(prepare, options=options, bounds=raw.thermal_range), [frames[i] for i in used])
        prepared = dict(zip(used, images, strict=True))
    check_equals({frames[i].name: p for i, p in prepared.items()})
    check_masks(prepared.values())
    raw = _with_temperatures(raw, [prepared[i] for i in train], notes)
    colour = {frames[i].name: p.colour for i, p in prepared.items() if p.colour > PSEUDO_COLOUR_LEVELS}
    raw = _with_pseudo_colour(raw, colour, options, notes)
    notes |= image_notes(prepared, options.downscale)
    if options.palette is not None:
        notes |= palette_notes(options.palette, {frames[i].name: p.fit for i, p in prepared.items()})

    if spans := [frames[i].span for i in used if frames[i].span is not None]:
        notes["bounds_source"] = f"{notes.get('bounds_source', 'frames')}: {spans_told(spans)}"
    stored: dict[int, _Stored] = {}
    for i in used:
        time_s = None if times is None else times[i] - first_s
        stored[i] = _store(i, frames[i], prepared.pop(i), time_s, origin, raw, options)
    bounds = raw.thermal_range
    if raw.counts and bounds:
        _check_bounds(raw.name, [stored[i] for i in train], raw.counts, bounds)
        notes["clipped_fraction"] = _clipped_fraction(list(stored.values()))
        if "training_images_c" in notes:
            _warn_of_cut_off(list(stored.values()), raw.counts, bounds)
    unknown = "none: image values are no temperatures, and errors in °C are undefined"
    notes["thermal_range_c"] = unknown if bounds is None else [bounds.min_c, bounds.max_c]

    def views(positions: Sequence[int]) -> ViewSet:
        items = [stored[i] for i in positions]
        return ViewSet([item.frame for item in items], lambda k: items[k].decode())

    shift = torch.from_numpy(origin)
    truth, true_attributes = raw.truth, raw.true_attributes
    return SceneData(
        name=raw.name,
        train=views(train),
        val=views(val),
        test=views(test),
        points=_tensor(raw.points - origin, np.float32),
        point_colors=_tensor(raw.point_colors, np.float32),
        thermal_range=bounds,
        ambient_c=raw.ambient_c,
        metres_per_unit=raw.metres_per_unit,
        weather=raw.weather,
        labels=_tensor(raw.labels, np.int64),
        point_features=_tensor(raw.point_features, np.float32),
        notes=notes,
        probes=None if raw.probes is None else _tensor(raw.probes - origin, np.float32),
        truth=truth and (lambda where, when: truth(where + shift.to(where), when + (first_s or 0.0))),
        true_attributes=true_attributes and (lambda where: true_attributes(where + shift.to(where))),
    )


def _tensor(values: np.ndarray | None, dtype: type) -> Tensor | None:
    return None if values is None else torch.from_numpy(values.astype(dtype))


# The steps of build_scene, in their order. Those that change what is known of a scene return it; what they assume they
# write into its notes.


def _without_bounds_of_photos(raw: RawScene, notes: dict[str, Any]) -> RawScene:
    """The scene without temperatures where it has photos alone. Raises SceneError where some frames are photos."""
    photos = sum(frame.read is None for frame in raw.frames)
    if not photos:
        return raw
    if thermal := len(raw.frames) - photos:
        raise SceneError(f"scene {raw.name} has thermal images of {thermal} frames and none of {photos}")
    notes["photos"] = "visible images only: an RGB scene, without thermal images and temperatures"
    return replace(raw, thermal_range=None)


def _with_range_of_spans(raw: RawScene, options: SceneOptions) -> RawScene:
    """The scene with the range that holds the spans of its frames, where they have such; without spans where it keeps colours."""
    spans = [frame.span for frame in raw.frames if frame.span is not None]
    if not spans:
        return raw
    if options.thermal_channels == 3:
        return replace(raw, frames=[replace(frame, span=None) for frame in raw.frames])
    if lacking := [frame.name for frame in raw.frames if frame.span is None]:
        raise SceneError(
            f"scene {raw.name}: {lacking[0]} has no span of temperatures, and {len(spans)} other images have one"
        )
    if raw.counts is not None:
        raise SceneError(
            f"scene {raw.name}: the numbers of its images have a map to °C, of which {BOUNDS_TABLE} changes nothing: take that "
            "file away"
        )
    return replace(raw, thermal_range=union(spans))


def _with_checked_numbers(raw: RawScene) -> RawScene:
    """The scene with its numbers as floats. Raises SceneError naming one that is none, or absurd."""
    ambient_c, metres = raw.ambient_c, raw.metres_per_unit
    if ambient_c is not None:
        ambient_c = celsius(ambient_c, f"ambient_c of scene {raw.name}")
    if metres is not None:
        metres = finite(metres, f"metres_per_unit of scene {raw.name}")
        if not metres > 0:
            raise SceneError(f"metres_per_unit of scene {raw.name} is {metres}; metres of one unit, above 0")
    return replace(raw, ambient_c=ambient_c, metres_per_unit=metres)


def _split(
    frames: Sequence[RawFrame], options: SceneOptions, notes: dict[str, Any]
) -> tuple[list[int], list[int], list[int]]:
    """Positions of the training, test and validation frames, each in order."""
    rule, names = options.split, [f.name for f in frames]
    train, test = rule(names, list(range(len(frames))), [f.subset for f in frames])
    left_out = len(frames) - len(set(train) | set(test))
    train, test = sorted(train), sorted(test)
    if options.every > 1:
        every_one, cameras = len(train), _by_camera([frames[i] for i in train])
        train = sorted(train[i] for own in cameras for i in own[:: options.every])
        each = f" of each of {len(cameras)} cameras" if len(cameras) > 1 else ""
        notes["every"] = f"{len(train)} of {every_one}, by data.every={options.every}{each}"
        log.info("images for training: %s", notes["every"])
        if rule.rule == ALL:
            test = sorted(train[i] for i in every_nth([names[i] for i in train])[1])
    val = [test[i] for i in evenly_spread(len(test), MAX_VAL_VIEWS)]
    notes |= {
        "split": rule.rule,
        "train_views": len(train),
        "test_views": len(test),
        "val_views": f"{len(val)} of the test views, evenly spaced; they draw curves and select nothing",
    }
    if both := sorted(set(train) & set(test)):
        notes["split_in_both"] = f"{counted(len(both), 'test frame')} trained on, too: {FITTED}"
    if rule.rule == ALL:
        log.info("data.split=all: nothing is held out; %s", notes["split_in_both"])
    elif both:
        log.warning(
            "data.split=%s: training and test have %s in common (%s), so that scores flatter the run; name each in one list",
            rule.rule, counted(len(both), "frame"), ", ".join(frames[i].name for i in both[:3]) + ", ..." * (len(both) > 3),
        )  # fmt: skip
    if left_out:
        notes["split_left_out"] = f"{counted(left_out, 'frame')} in neither list, not used"
    return train, test, val


def _by_camera(frames: Sequence[RawFrame]) -> list[list[int]]:
    """Positions of the frames of each camera, in order: cameras differ by the folder of their images and by their lens, or by
    folder and size of image where many a frame has a lens of its own, as reconstructions may fit them."""
    folders = [PurePosixPath(frame.name).parent for frame in frames]
    lenses = [frame.lens for frame in frames]
    for kinds in (lenses, [(lens.width, lens.height) for lens in lenses]):
        cameras: dict[Any, list[int]] = {}
        for i, kind in enumerate(zip(folders, kinds, strict=True)):
            cameras.setdefault(kind, []).append(i)
        if 2 * len(cameras) <= len(frames):
            return list(cameras.values())
    return [list(range(len(frames)))]


def _with_finite_points(raw: RawScene, notes: dict[str, Any]) -> RawScene:
    """The scene with float64 points [P, 3] of usable coordinates, and the rows that belong to them."""
    if raw.points is None:
        raise SceneError(
            f"scene {raw.name} has no points: give points [P, 3] to start from, such as those of the sparse model"
        )
    points = np.asarray(raw.points, dtype=np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SceneError(f"points of scene {raw.name} must be [P, 3], got {list(points.shape)}")
    kept = (np.abs(points) <= MAX_COORDINATE).all(axis=1)
    rows = {name: _of_points(name, getattr(raw, name), kept) for name in ("labels", "point_features", "point_colors")}
    points = points[kept]
    notes["points"] = len(points)
    if len(points) < len(kept):
        notes["points_dropped"] = (
            f"{counted(len(kept) - len(points), 'point')} with NaN, infinite or absurdly large coordinates"
        )
    if len(points) < 4:
        raise SceneError(
            f"scene {raw.name} has {len(points)} finite points, at least 4 are needed to start from; "
            "check points3D in the sparse model"
        )
    return replace(raw, points=points, **rows)


def _with_weather_since(raw: RawScene, first_s: float | None, notes: dict[str, Any]) -> RawScene:
    """The scene with its weather on a clock that starts at ``first_s``, which is None where frames have no times."""
    if raw.weather is None:
        return raw
    if first_s is None:
        raise SceneError(f"scene {raw.name} has weather, but its frames have no times: which weather belongs to which?")
    weather = raw.weather.since(first_s)
    notes |= {f"weather_{key}": value for key, value in weather.notes.items()}
    return replace(raw, weather=weather)


def _with_temperatures(raw: RawScene, train: Sequence[PreparedImage], notes: dict[str, Any]) -> RawScene:
    """The scene with the map to °C that float pixels say, and the bounds that training images say, where none are given."""
    counts, bounds = raw.counts, raw.thermal_range
    if train[0].found["type"] == "float32" and counts is None:
        counts = CELSIUS
        notes["encoding"] = "float pixels are temperatures in °C"
    if counts and bounds is None:
        bounds, notes["training_images_c"] = _range_of(train, counts)
        notes["bounds_source"] = "minimum and maximum of the training images without dead pixels: none were given"
    return replace(raw, counts=counts, thermal_range=bounds)


def _with_pseudo_colour(
    raw: RawScene, colour: Mapping[str, float], options: SceneOptions, notes: dict[str, Any]
) -> RawScene:
    """The scene without bounds where it keeps pseudo-colour. Raises SceneError where ``colour`` would be temperatures.

    Args:
        colour: grey levels by which the channels of an image differ, by name, of those that are pseudo-colour.
    """
    if options.thermal_channels == 3:
        if raw.thermal_range is not None:
            notes["bounds_ignored"] = "three thermal channels are pseudo-colour, which has no temperature"
        return replace(raw, thermal_range=None)
    if colour and raw.thermal_range is not None:
        raise SceneError(
            f"image {next(iter(colour))} of scene {raw.name} is pseudo-colour (its channels differ by "
            f"{max(colour.values()):.0f} grey levels on average), so its values are no temperatures although the scene "
            "has bounds. Name the palette (data.palette=iron, or a picture of its colour bar), point the loader at grey "
            "images, or train on the colours with data.thermal_channels=3 (no °C)."
        )
    if colour:
        notes["pseudo_colour"] = (
            f"{counted(len(colour), 'image')} in pseudo-colour; the luma is used and is no temperature"
        )
        log.warning(
            "%s, such as %s: a palette's luma need not rise with temperature. Name the palette (data.palette=iron, or a picture "
            "of its colour bar), or give radiometric files, counts, or greys with their bounds; data.thermal_channels=3 trains "
            "on the colours as they are, without °C",
            *(notes["pseudo_colour"], next(iter(colour))),
        )
    return raw


def _store(
    frame_id: int,
    frame: RawFrame,
    pixels: PreparedImage,
    time_s: float | None,
    origin: np.ndarray,
    raw: RawScene,
    options: SceneOptions,
) -> _Stored:
    """The view of a frame about ``origin``, with the scene's weather where it has none of its own."""
    viewmat = frame.viewmat.astype(np.float64, copy=True)
    viewmat[:3, 3] += viewmat[:3, :3] @ origin
    lens = pixels.lens
    camera = Camera(torch.from_numpy(viewmat), torch.from_numpy(lens.matrix()), lens.width, lens.height)
    environment = frame.environment
    if raw.weather is not None and environment is None:
        environment = weather_at_frame(raw.weather, frame.name, time_s)
    about = Frame(name=frame.name, frame_id=frame_id, camera=camera, time_s=time_s, environment=environment)
    kind, counts = np.dtype(pixels.found["type"]), raw.counts
    if frame.span is not None and kind.kind == "u":
        counts = Counts(frame.span.span_k / np.iinfo(kind).max, frame.span.min_c)
    zero, full = _scaling(kind, counts, raw.thermal_range)
    return _Stored(about, pixels.thermal, pixels.rgb, pixels.mask, zero, full, options.thermal_channels, pixels.ends)


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


def _in_order(frames: Sequence[RawFrame]) -> tuple[list[RawFrame], list[float] | None, dict[str, Any]]:
    """Frames by (time, name), their times or None, and what to note about them."""
    known = [f.time_s for f in frames if f.time_s is not None]
    if len(known) < len(frames):
        notes: dict[str, Any] = {"time": "none: only static methods apply"}
        if known:
            lacking = next(f.name for f in frames if f.time_s is None)
            notes["time"] = (
                f"none: {len(known)} of {len(frames)} frames have a time, {lacking} has not, so none is used"
            )
            log.warning("times: %s", notes["time"])
        return sorted(frames, key=lambda f: f.name), None, notes
    frames = sorted(frames, key=lambda f: (f.time_s, f.name))
    times = [float(f.time_s) for f in frames]
    for frame, time in zip(frames, times, strict=True):
        if not abs(time) <= LAST_EPOCH_S:
            units = {
                "nanoseconds": 1e9,
                "microseconds": 1e6,
                "milliseconds": 1e3,
            }  # since 1970, as cameras' programs count
            fits = next((unit for unit, count in units.items() if FIRST_EPOCH_S < time / count < LAST_EPOCH_S), None)
            told = f"; divide {fits} since 1970 by {units[fits]:,.0f}" if fits else ""
            raise SceneError(
                f"frame {frame.name} has a time that is no finite number of seconds, or absurdly large: {time:.15g}{told}"
            )
    notes = {"duration_s": times[-1] - times[0]}
    if repeated := len(times) - len(set(times)):
        notes["duplicate_times"] = f"{counted(repeated, 'frame')} with the time of another one; all are kept"
        log.warning("%s", notes["duplicate_times"])
    return frames, times, notes


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


def _range_of(prepared: Sequence[PreparedImage], counts: Counts) -> tuple[ThermalRange, list[float]]:
    """Bounds that hold all unmasked pixels, and the minimum and maximum of those with dead ones, in °C.

    Not percentiles: a defect of a few hot pixels is what an inspection looks for. Dead pixels and counts at absolute zero are
    no temperatures of the scene and clip, so that they do not flatten it.
    """
    dead = _dead_pixels(prepared)
    lows, highs, all_lows, all_highs = [], [], [], []
    for p in prepared:
        known = np.ones(p.thermal.shape, dtype=bool) if p.mask is None else p.mask
        least = (MIN_CELSIUS - counts.offset_c) / counts.scale
        for keep, low, high in (
            (known, all_lows, all_highs),
            (known & ~dead[p.thermal.shape] & (p.thermal > least), lows, highs),
        ):
            if keep.any():
                low.append(float(p.thermal[keep].min()))
                high.append(float(p.thermal[keep].max()))
    low, high = (min(lows), max(highs)) if lows else (0.0, 0.0)
    if not low < high:
        what = f"are constant ({counts.scale * low + counts.offset_c:g} °C)" if lows else "have no pixel that counts"
        raise SceneError(
            f"the training images {what}, so no temperature range can be taken from them: was the shutter closed, or did the "
            "export lose what they show? Else give data.bounds_c=[min,max] (data=colmap) or temperature_bounds.json"
        )
    margin = RANGE_MARGIN * (high - low)
    ends = (low - margin, high + margin, min(all_lows), max(all_highs))
    low_c, high_c, *seen_c = (counts.scale * end + counts.offset_c for end in ends)
    return ThermalRange(max(low_c, MIN_CELSIUS), high_c), seen_c


def _dead_pixels(prepared: Sequence[PreparedImage]) -> dict[tuple[int, ...], np.ndarray]:
    """Dead pixels [H, W] bool by the size of images, told from a few of the images of that size."""
    sizes: dict[tuple[int, ...], list[PreparedImage]] = {}
    for p in prepared:
        sizes.setdefault(p.thermal.shape, []).append(p)
    found = {}
    for size, alike in sizes.items():
        few = [alike[i] for i in evenly_spread(len(alike), DEAD_PIXEL_FRAMES)]
        images = np.stack([p.thermal.astype(np.float32) for p in few])
        for image, p in zip(images, few, strict=True):
            if p.mask is not None:
                image[~p.mask] = np.nan
        found[size] = dead_pixels(torch.from_numpy(images)).numpy()
    return found


def _scaling(dtype: np.dtype, counts: Counts | None, bounds: ThermalRange | None) -> tuple[float, float]:
    """(zero, full): an image value in [0, 1] is (stored - zero) / full."""
    if counts is None or bounds is None:
        return 0.0, float(np.iinfo(dtype).max) if dtype.kind == "u" else 1.0
    return (bounds.min_c - counts.offset_c) / counts.scale, bounds.span_k / counts.scale


def _outside(stored: _Stored) -> np.ndarray:
    """Which pixels [H, W] lie outside the bounds and are clipped to them."""
    return (stored.thermal < stored.zero) | (stored.thermal > stored.zero + stored.full)


def _clipped_fraction(stored: Sequence[_Stored]) -> float:
    """Share of the pixels that count which lie outside the bounds and are clipped to them."""
    count = sum(s.thermal.size if s.mask is None else int(s.mask.sum()) for s in stored)
    return sum(int((_outside(s) if s.mask is None else _outside(s) & s.mask).sum()) for s in stored) / max(count, 1)


def _check_bounds(name: str, train: Sequence[_Stored], counts: Counts, bounds: ThermalRange) -> None:
    """Raises SceneError where bounds leave next to nothing of the training images."""
    outside = total = 0
    lows, highs = [], []
    for s in train:
        known = np.ones(s.thermal.shape, dtype=bool) if s.mask is None else s.mask
        if known.any():
            outside, total = outside + int(_outside(s)[known].sum()), total + int(known.sum())
            lows.append(float(s.thermal[known].min()))
            highs.append(float(s.thermal[known].max()))
    if total and outside > MAX_OUTSIDE * total:
        low, high = (counts.scale * end + counts.offset_c for end in (min(lows), max(highs)))
        raise SceneError(
            f"scene {name}: {100 * outside / total:.4g} % of the pixels of the training images lie beyond the bounds "
            f"{bounds.min_c:g} .. {bounds.max_c:g} °C; the images show {low:.4g} .. {high:.4g} °C. Give bounds in °C that hold "
            f"them: data.bounds_c=[min,max] with data=colmap, else {BOUNDS_FILE}. If the bounds are right, the unit of the "
            "images is not (kelvin?)"
        )


def _warn_of_cut_off(stored: Sequence[_Stored], counts: Counts, bounds: ThermalRange) -> None:
    """Warns of pixels that count and lie beyond bounds that nobody gave: dead ones, or those of held-out images."""
    cut = np.concatenate([s.thermal[_outside(s) if s.mask is None else _outside(s) & s.mask] for s in stored])
    if cut.size:
        low, high = (counts.scale * float(end) + counts.offset_c for end in (cut.min(), cut.max()))
        log.warning(
            "%d pixels of %.4g .. %.4g °C are cut off: the bounds %.4g .. %.4g °C hold the training images without dead "
            "pixels. Leave dead pixels out with masks/, or give data.bounds_c=[min,max] (data=colmap) or %s",
            *(cut.size, low, high, bounds.min_c, bounds.max_c, BOUNDS_FILE),
        )
