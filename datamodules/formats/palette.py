"""Palettes of pseudo-colour pictures: by name, from the picture of a colour bar, or out of a FLIR file."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import cv2
import matplotlib
import numpy as np

from heatsplat.contracts import SceneError, check_option
from heatsplat.datamodules.formats import flir
from heatsplat.datamodules.formats.images import SUFFIXES, read_bytes, read_image, shown_files, split_alpha
from heatsplat.datamodules.side_files import found_file

KEY = "data.palette"
EMBEDDED = "embedded"
SIDES = ("top", "bottom", "left", "right")
OPENCV = "opencv_"
REVERSED = "_r"
NAMES = (
    "iron, matplotlib's colour maps (inferno, jet, ...) and OpenCV's (opencv_jet, ...), each with _r from hot to cold"
)
# Iron as a FLIR ONE Pro writes it into its files, to 1.4 of 256: luma, and red and blue chroma by powers of the level.
IRON = np.array([[16.0, 219.0, 0.0, 0.0], [-27.4, 451.6, -594.8, 163.3], [11.6, 590.2, -2107.0, 1507.4]])

# What colours are compared in: luma and 0.35 of each chroma, of 256. JPEG keeps chroma at half the resolution and more coarsely,
# and levels found so err by a third less beside edges than those found in RGB.
PERCEIVED = np.array([[0.299, 0.587, 0.114], [-0.0591, -0.1159, 0.175], [0.175, -0.1465, -0.0285]]).T

MIN_BAR_PX = 16  # along a bar, fewer do not show its palette
# Mean difference of the colours across a bar, in units of PERCEIVED; a picture of a scene has 20 and more.
MOST_UNEVEN = 12.0
BAR_NOISE = 1.5  # in those units: colours along a bar that differ by less are one
FRAME_SHARE, FRAME_STEP = 0.04, 12.0  # of a bar's ends that may be its frame, told by such a step


@dataclass(frozen=True)
class Palette:
    """The colours of a scale.

    Args:
        name: for messages.
        colours: RGB [N, 3] float64, 0 .. 255, from cold to hot; none equals the one before it.
        levels: [N] rising, in [0, 1]: where on the scale each stands.
        key: of the setting that names it, for messages.
    """

    name: str
    colours: np.ndarray
    levels: np.ndarray
    key: str = KEY

    def curve(self, count: int) -> np.ndarray:
        """Colours [count, 3] at evenly spaced levels from 0 to 1, straight between neighbouring entries."""
        at = np.linspace(0.0, 1.0, count)
        return np.stack([np.interp(at, self.levels, channel) for channel in self.colours.T], axis=1)


def palette_of(setting: str, hot: str | None, folder: Path | None, key: str = KEY) -> Palette:
    """The palette that a setting and the one beside it (``data.palette``, ``data.palette_hot``) name.

    Args:
        setting: a name (``NAMES``), "embedded" for that in the FLIR files of the scene, or a file: the picture of a colour bar
            alone, or a FLIR file that holds a palette.
        hot: side of the bar at which it is hottest: top, bottom, left or right; None for top or right.
        folder: of the scene, in which files are looked for before the working directory; None where it has none.
        key: of the setting.

    Raises:
        SceneError: there is no such name or file, or the file shows no palette.
    """
    if hot is not None:
        check_option(f"{key}_hot", hot, SIDES, SceneError)
    if found := named(setting):
        palette = found
    elif setting == EMBEDDED:
        palette = _embedded_in(folder, key)
    elif Path(setting).suffix.lower() in (*SUFFIXES, ".fff"):
        path = found_file(key, setting, folder)
        if not flir.payload_of(read_bytes(path)):
            return bar_of(path, hot, key)
        palette = _in_flir(path)
        if palette is None:
            raise SceneError(f"{key}={setting}: {path} is a FLIR file without a palette; give {_remedy(key)}")
    else:
        alike = difflib.get_close_matches(setting, [*_names()], 3)
        meant = f" (did you mean {' or '.join(alike)}?)" if alike else ""
        raise SceneError(f"{key}={setting} is no palette{meant}; give {_remedy(key)}")
    if hot is not None:
        raise SceneError(
            f"{key}_hot={hot} is for the picture of a colour bar; of {palette.name}, _r behind the name turns the "
            "direction round, and palettes in files have one"
        )
    return replace(palette, key=key)


def _remedy(key: str) -> str:
    return f"one of {NAMES}, or the picture of the colour bar alone, cut out of one of the images ({key}=bar.png)"


@cache  # images in doubt are compared with all of them, each time
def named(name: str) -> Palette | None:
    """The palette of a name, or None."""
    base = name.removesuffix(REVERSED)
    if name in matplotlib.colormaps:
        colours = matplotlib.colormaps[name](np.linspace(0.0, 1.0, 256))[:, :3] * 255.0
    elif base == "iron":
        colours = _rgb((IRON @ np.linspace(0.0, 1.0, 256) ** np.arange(4)[:, None]).T)
    elif base.startswith(OPENCV) and base in _opencv_names():
        map_ = getattr(cv2, f"COLORMAP_{base.removeprefix(OPENCV).upper()}")
        colours = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], map_)[:, 0, ::-1].astype(np.float64)
    else:
        return None
    turned = base != name and name not in matplotlib.colormaps
    return _palette(name, colours[::-1] if turned else colours)


def _opencv_names() -> list[str]:
    return [f"{OPENCV}{name.removeprefix('COLORMAP_').lower()}" for name in dir(cv2) if name.startswith("COLORMAP_")]


def _names() -> Iterator[str]:
    yield from ("iron", EMBEDDED, *matplotlib.colormaps, *_opencv_names())


def known() -> Iterator[Palette]:
    """All palettes that have a name, from cold to hot."""
    for name in _names():
        if not name.endswith(REVERSED) and name != EMBEDDED:
            yield named(name)


def _rgb(luma_chroma: np.ndarray) -> np.ndarray:
    """RGB [N, 3] of luma (0 .. 255), red and blue chroma (around 0), as JFIF has them."""
    y, cr, cb = luma_chroma.T
    return np.clip(np.stack([y + 1.402 * cr, y - 0.344136 * cb - 0.714136 * cr, y + 1.772 * cb], axis=1), 0.0, 255.0)


def _palette(name: str, colours: np.ndarray, noise: float = 0.0, key: str = KEY) -> Palette:
    """The palette of evenly spaced colours [N, 3]; those in a row that differ by no more than ``noise`` become one, in the middle
    of their levels."""
    compared = colours @ PERCEIVED
    first = [0]
    for i in range(1, len(colours)):
        if np.linalg.norm(compared[i] - compared[first[-1]]) > noise:
            first.append(i)
    runs = [slice(a, b) for a, b in zip(first, [*first[1:], len(colours)], strict=True)]
    at = np.linspace(0.0, 1.0, len(colours))
    if len(runs) < 2:
        raise SceneError(f"{key}: {name} shows one colour alone, which is no scale")
    means = np.stack([colours[run].mean(axis=0) for run in runs])
    return Palette(name, means, np.array([at[run].mean() for run in runs]), key)


# Files ----------------------------------------------------------------------------------------------------------------


def bar_of(path: Path, hot: str | None = None, key: str = KEY) -> Palette:
    """The palette of a picture of a colour bar, which is taken to lie along the side along which colours change.

    Colours are medians over the middle half of the bar, so that ticks at its sides do no harm; lines of a frame around it
    are left out.

    Args:
        path: of the picture.
        hot: side at which it is hottest: top, bottom, left or right; None for top or right.
        key: of the setting that names it.

    Raises:
        SceneError: it is no colour picture of 8 bits, too small, or shows no bar.
    """
    pixels, _ = split_alpha(read_image(path))
    if pixels.dtype != np.uint8 or pixels.ndim != 3:
        raise SceneError(f"{key}: {path} is no colour picture of 8 bits; cut the bar out of one of the images")
    pixels = pixels.astype(np.float64)
    spreads = [(_half(_middle(pixels, along)) @ PERCEIVED).std(axis=0).max() for along in (0, 1)]
    along = {None: int(np.argmax(spreads)), "left": 1, "right": 1}.get(hot, 0)
    if hot is None and max(spreads) < 2.0 * min(spreads):
        raise SceneError(
            f"{key}: {path} does not tell along which side its colours change; cut out the bar alone, without "
            f"its numbers, or say at which side it is hottest: {key}_hot=top"
        )
    line = _middle(pixels, along)
    across = _half(pixels.swapaxes(0, 1) if along == 0 else pixels)
    uneven = np.linalg.norm((across - line) @ PERCEIVED, axis=2).mean()
    line = line[_without_frame(line @ PERCEIVED)]
    if len(line) < MIN_BAR_PX or uneven > MOST_UNEVEN:
        what = f"{len(line)} pixels long" if len(line) < MIN_BAR_PX else "of several colours across"
        raise SceneError(
            f"{key}: {path} is {what}, and no colour bar of {MIN_BAR_PX} pixels or more; cut the bar alone, without its "
            "numbers, out of one of the images"
        )
    if (hot or ("top", "right")[along]) in ("top", "left"):
        line = line[::-1]
    return _palette(str(path), line, BAR_NOISE, key)


def _middle(pixels: np.ndarray, along: int) -> np.ndarray:
    """Median colours [N, 3] along rows (0) or columns (1), over the middle half across."""
    return np.median(_half(pixels.swapaxes(0, 1) if along == 0 else pixels), axis=0)


def _half(values: np.ndarray) -> np.ndarray:
    """The middle half along the first axis, at least one of them."""
    quarter = (len(values) - 1) // 4
    return values[quarter : len(values) - quarter]


def _without_frame(line: np.ndarray) -> slice:
    """The part of a line of colours [N, 3] between steps close to its ends."""
    steps = np.linalg.norm(np.diff(line, axis=0), axis=1)
    most = max(3, int(FRAME_SHARE * len(line)))
    if len(steps) < 2 * most:
        return slice(None)
    jumps = steps > max(FRAME_STEP, 6.0 * float(np.median(steps)))
    first = int(np.flatnonzero(jumps[:most]).max(initial=-1)) + 1
    last = len(line) - 1 - (int(np.flatnonzero(jumps[::-1][:most]).max(initial=-1)) + 1)
    return slice(first, last + 1)


def _in_flir(path: Path) -> Palette | None:
    """The palette in a FLIR file; None where it holds none."""
    payload = flir.payload_of(read_bytes(path))
    found = flir.Record(payload, str(path)).palette() if payload else None
    return None if found is None else _palette(f"the palette in {path}", _rgb(found))


def _embedded_in(folder: Path | None, key: str) -> Palette:
    """The palette that the FLIR files of a scene hold. Raises SceneError where there is none, or they hold several."""
    found: list[tuple[Path, Palette]] = []
    paths: Iterable[Path] = () if folder is None else sorted(shown_files(folder, (".jpg", ".jpeg", ".fff")))
    for path in paths:
        if palette := _in_flir(path):
            found.append((path, palette))
            first, seen = found[0]
            if palette.colours.shape != seen.colours.shape or np.abs(palette.colours - seen.colours).max() > 2.0:
                raise SceneError(
                    f"{key}={EMBEDDED}: {first} and {path} hold different palettes; put the pictures of each into a scene "
                    f"of its own, or name the file whose palette all have: {key}={first.name}"
                )
    if not found:
        raise SceneError(
            f"{key}={EMBEDDED}: no FLIR file in {folder} holds a palette; give {_remedy(key)}, or a FLIR file of the same "
            "camera that holds one"
        )
    return found[0][1]
