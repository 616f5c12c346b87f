"""Pixels on their final grid: one frame's files read, freed of distortion and downscaled; what a scene's have in common."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from heatsplat.contracts import SceneError, ThermalRange, counted
from heatsplat.datamodules.bounds import MAX_CELSIUS, MIN_CELSIUS, ends_of
from heatsplat.datamodules.formats.images import (
    colour_levels,
    resized,
    resized_ends,
    resized_mask,
    split_alpha,
    to_grey,
    undistorted,
    undistorted_ends,
    undistorted_mask,
)
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.formats.pseudo_colour import Fit
from heatsplat.datamodules.raw_scene import RawFrame, SceneOptions

log = logging.getLogger(__name__)

# Share by which the sides of an image may differ in their scale from its camera's: those that COLMAP's undistorter trims
# do by about a hundredth, 4:3 and 5:4 by 7 of them.
MOST_SQUEEZED = 0.03
SMALL_PX = 11  # along the shorter side, below which images that were downscaled are warned of: the window of SSIM
MOST_MASKED = 0.9  # share of all pixels that masks leave out, from which they are rather the wrong way round


@dataclass(frozen=True)
class PreparedImage:
    """Pixels of one frame on their final grid, in the stored type.

    Args:
        thermal, rgb, mask: of one size; None for what the frame lacks.
        lens: without distortion, for that size.
        found: what the files held, for the notes.
        colour: grey levels by which the channels of the thermal image differ on average; 0 where a palette made one of them.
        fit: how well the thermal image fits its palette; None without one.
        ends: [H, W] int8, where the thermal image was cut off (``View.ends``); None where it was not.
    """

    thermal: np.ndarray | None
    rgb: np.ndarray | None
    mask: np.ndarray | None
    lens: Lens
    found: dict[str, Any]
    colour: float
    fit: Fit | None = None
    ends: np.ndarray | None = None


def prepare(frame: RawFrame, options: SceneOptions, bounds: ThermalRange | None = None) -> PreparedImage:
    """Pixels of one frame on their final grid, undistorted, with the lens that belongs to them.

    Args:
        bounds: of the scene, where frames have spans of their own.
    """
    read = frame.read or frame.read_rgb
    if read is None:
        raise SceneError(f"frame {frame.name} has neither a thermal nor a visible image")
    pixels, alpha = split_alpha(_supported(read(), frame.name))
    height, width = pixels.shape[:2]
    if frame.read is None:
        pixels = _three_channels(pixels, frame.name)
    colour = colour_levels(pixels)
    found = {
        "size": f"{width}x{height}",
        "type": str(pixels.dtype),
        "channels": ("L" if pixels.ndim == 2 else "RGB") + ("A" if alpha is not None else ""),
        "model": frame.lens.model,
        "distorted": frame.lens.is_distorted,
        "camera": f"{frame.lens.width}x{frame.lens.height}",
        "squeezed": _squeezed(width, height, frame.lens.width, frame.lens.height),
        "nan": 0,
        "at_ends": 0,
        "rgb_resized": False,
        "rgb_squeezed": False,
    }
    own = _mask_of(frame, width, height)
    found["mask_resized"] = own is not None and own.shape != (height, width)
    mask = _both(alpha if options.alpha_mask else None, None if own is None else resized_mask(own, width, height))
    fit = None
    if options.palette is not None:
        if frame.read is None:
            raise SceneError("data.palette is of thermal images, and the scene has photos alone; leave it out")
        levels = options.palette.read(pixels, mask, frame.name)
        pixels, fit, colour = levels.levels, levels.fit, 0.0
        mask = mask if levels.known.all() else _both(mask, levels.known)
    keeps_colour = frame.read is None or options.thermal_channels == 3
    if pixels.ndim == 3 and (pixels.dtype.kind == "f" or not keeps_colour):
        pixels = to_grey(pixels)
    if pixels.dtype.kind == "f":
        pixels, known = _filled(pixels, frame.name)
        if known is not None:
            found["nan"], mask = int(known.size - known.sum()), _both(mask, known)
    ends = None
    if frame.span is not None and options.thermal_channels == 1:
        ends = _ends_of(pixels, frame, bounds)
        found["at_ends"] = int(((ends != 0) if mask is None else (ends != 0) & mask).sum())
        ends = ends if ends.any() else None
    rgb = None
    if frame.read is not None and frame.read_rgb is not None:
        rgb, _ = split_alpha(_supported(frame.read_rgb(), f"{frame.name} (visible)"))
        rgb = _three_channels(rgb, frame.name)
        found["rgb_resized"] = rgb.shape[:2] != (height, width)
        found["rgb_squeezed"] = _squeezed(rgb.shape[1], rgb.shape[0], width, height) > MOST_SQUEEZED
        rgb = resized(rgb, width, height)
    lens = frame.lens.resized(width, height)
    if lens.is_distorted:
        pixels, mask = undistorted(pixels, lens), undistorted_mask(mask, lens)
        ends = undistorted_ends(ends, lens)
        rgb = None if rgb is None else undistorted(rgb, lens)
    small = (width, height)
    if options.downscale > 1:
        small = tuple(_shrunk(side / options.downscale, options.multiple) for side in (width, height))
    pixels = resized(pixels, *small)
    rgb = None if rgb is None else np.ascontiguousarray(resized(rgb, *small))
    mask = None if mask is None else resized_mask(mask, *small)
    ends = None if ends is None else resized_ends(ends, *small)
    if mask is not None and mask.all():
        mask = None
    if frame.read is None:
        return PreparedImage(None, np.ascontiguousarray(pixels), mask, lens.resized(*small), found, colour=0.0)
    return PreparedImage(np.ascontiguousarray(pixels), rgb, mask, lens.resized(*small), found, colour, fit, ends)


def _shrunk(side: float, multiple: int) -> int:
    """The whole number of pixels, a multiple, that is nearest to a side."""
    return max(1, round(side / multiple)) * multiple


def _squeezed(width: int, height: int, of_width: int, of_height: int) -> float:
    """By what share the two sides of an image differ in their scale from those that they should have, beyond a pixel of each
    side that rounding may take."""
    differs = abs(math.log(width / of_width * of_height / height))
    return max(0.0, differs - 1.0 / width - 1.0 / height)


def _mask_of(frame: RawFrame, width: int, height: int) -> np.ndarray | None:
    """The frame's mask, None where it has none; it may be that of a photo, of another size. Raises SceneError where it has
    another shape."""
    if frame.read_mask is None:
        return None
    mask = frame.read_mask()
    down, across = mask.shape
    if min(down, across) < 1 or _squeezed(width, height, across, down) > MOST_SQUEEZED:
        raise SceneError(
            f"mask of {frame.name} is {across}x{down} but the image is {width}x{height}, which has another shape; crop the mask "
            f"to what the image shows, or use no masks: data.masks=null, and no mask_path in transforms.json"
        )
    return mask


def _both(mask: np.ndarray | None, other: np.ndarray | None) -> np.ndarray | None:
    """Where a pixel counts by both masks; None where there are none."""
    if mask is None or other is None:
        return other if mask is None else mask
    return mask & other


def _filled(celsius: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray | None]:
    """The image with values where it has none, and which pixels had one; None where all had."""
    known = (celsius >= MIN_CELSIUS) & (celsius <= MAX_CELSIUS)
    if known.all():
        return celsius, None
    if not known.any():
        raise SceneError(f"image {name} holds no finite pixel that is a temperature in °C; remove it from the scene")
    # Any finite filling will do under the mask; the median keeps resampling well-behaved beside it.
    return np.where(known, celsius, np.median(celsius[known])), known


def _ends_of(pixels: np.ndarray, frame: RawFrame, bounds: ThermalRange | None) -> np.ndarray:
    """Where the image of a frame with a span was cut off (``bounds.ends_of``)."""
    low, width = frame.span.min_c, frame.span.span_k
    if pixels.dtype.kind == "u":
        low, width = 0.0, float(np.iinfo(pixels.dtype).max)
    return ends_of((pixels.astype(np.float32) - low) / width, frame.span, bounds or frame.span)


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


def check_equals(prepared: Mapping[str, PreparedImage]) -> None:
    """Raises SceneError for an image of another type than the others, another size than those of its camera, or another shape
    than the camera."""
    cameras: dict[Any, list[tuple[str, PreparedImage]]] = {}
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
            if size != most and count >= 3 and (sizes[size] == 1 or size != p.found["camera"]):
                raise SceneError(
                    f"image {name} is {size}, but {count} others of the same camera are {most}; copy or export it again"
                )
    squeezed = [name for name, p in prepared.items() if p.found["squeezed"] > MOST_SQUEEZED]
    if squeezed:
        name, found = squeezed[0], prepared[squeezed[0]].found
        raise SceneError(
            f"image {name} is {found['size']}, but its camera is {found['camera']}, which has another shape "
            f"({len(squeezed)} of {counted(len(prepared), 'image')} differ so); correct width and height of the camera (w and h "
            "in transforms.json, the cameras of a COLMAP model), or give images that are neither turned nor cropped"
        )


def check_masks(prepared: Iterable[PreparedImage]) -> None:
    """Warns where masks leave next to nothing of a scene, as those the wrong way round do. Raises SceneError where they leave
    nothing."""
    images = list(prepared)
    count = sum(p.lens.width * p.lens.height for p in images)
    left = count - sum(int((~p.mask).sum()) for p in images if p.mask is not None)
    says = (
        "data.mask_keep is white where white pixels count, black where they are left out; data.masks=null uses no masks"
    )
    if not left:
        raise SceneError(f"masks or transparency leave out all pixels of all images; {says}")
    if left < (1.0 - MOST_MASKED) * count:
        log.warning("masks or transparency leave out %.4g %% of all pixels; %s", 100.0 * (1.0 - left / count), says)


def image_notes(prepared: Mapping[int, PreparedImage], downscale: float) -> dict[str, Any]:
    """What the images of a scene have in common and where they differ; what is doubtful about that is warned of."""
    images = list(prepared.values())
    found = [p.found for p in images]

    def tally(key: str) -> str:
        counts = Counter(str(f[key]) for f in found)
        return next(iter(counts)) if len(counts) == 1 else ", ".join(f"{k} ({n})" for k, n in counts.items())

    notes: dict[str, Any] = {
        "image_size": tally("size"),
        "pixel_type": tally("type"),
        "channels": tally("channels"),
        "camera_model": tally("model"),
        "downscale": downscale,
        "grid": ", ".join(dict.fromkeys(f"{p.lens.width}x{p.lens.height}" for p in images)),
    }
    _warn_of_small(images, downscale)
    notes |= _rescaled_notes(found)
    if distorted := sum(f["distorted"] for f in found):
        notes["distortion"] = f"{counted(distorted, 'image')} undistorted onto a pinhole of the same focal length"
    if nan := sum(f["nan"] for f in found):
        notes["nan_pixels"] = f"{counted(nan, 'pixel')} masked: NaN, infinite or below absolute zero"
        log.warning("%s", notes["nan_pixels"])
    if at_ends := [f["at_ends"] / math.prod(map(int, f["size"].split("x"))) for f in found if f["at_ends"]]:
        notes["span_ends"] = (
            f"{100 * sum(at_ends) / len(found):.2g} % of the pixels, at most {100 * max(at_ends):.2g} % of an image, lie at an "
            "end of their image's span beyond which other images reach: the truth is taken for that or beyond"
        )
        log.info("%s", notes["span_ends"])
    notes |= _visible_notes(found)
    if resized_masks := sum(f["mask_resized"] for f in found):
        notes["masks_resized"] = f"{counted(resized_masks, 'mask')} of another size, resized to the image's"
    if masked := [p.mask for p in images if p.mask is not None]:
        pixels = sum(p.lens.width * p.lens.height for p in images)
        notes["masked_fraction"] = sum(int((~m).sum()) for m in masked) / pixels
    return notes


def _warn_of_small(images: Iterable[PreparedImage], downscale: float) -> None:
    """Warns of images of which downscaling leaves next to nothing."""
    least = min((p.lens for p in images), key=lambda lens: min(lens.width, lens.height))
    if downscale > 1 and min(least.width, least.height) < SMALL_PX:
        log.warning(
            "data.downscale=%g leaves images of %dx%d pixels, of which nothing is seen and SSIM needs %d along each side",
            downscale, least.width, least.height, SMALL_PX,
        )  # fmt: skip


def _rescaled_notes(found: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Which images have another size than their camera."""
    rescaled = Counter((f["size"], f["camera"]) for f in found if f["size"] != f["camera"])
    if not rescaled:
        return {}
    pairs = ", ".join(
        f"{counted(n, 'image')} of {size} with a camera of {of}" for (size, of), n in rescaled.most_common(3)
    )
    note, level = f"{pairs}: intrinsics follow the image", logging.INFO
    if any(f["squeezed"] for f in found):
        note += ", by another factor across than down; if images were cropped, give cameras of those"
        level = logging.WARNING
    log.log(level, "%s", note)
    return {"intrinsics_rescaled": note}


def _visible_notes(found: Sequence[Mapping[str, Any]]) -> dict[str, str]:
    """Which visible images have another size or shape than the thermal ones."""
    resized_ones, squeezed = (sum(f[key] for f in found) for key in ("rgb_resized", "rgb_squeezed"))
    if not resized_ones:
        return {}
    note = f"{counted(resized_ones, 'visible image')} resized to the thermal grid"
    if squeezed:
        note += f", {squeezed} of which have another shape"
        log.warning(
            "%s have another shape than the thermal ones and are squeezed onto them: crop or rectify them to what the thermal "
            "camera sees, or leave them out (data.rgb)", counted(squeezed, "visible image"),
        )  # fmt: skip
    return {"rgb_resized": note}
