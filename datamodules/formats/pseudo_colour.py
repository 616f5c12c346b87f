"""Levels of pictures in false colours: where on the curve of their palette each colour lies nearest.

Colours are compared in luma and 0.35 of each chroma, of 256 (``palette.PERCEIVED``); all distances here are in these units. JPEG
moves most pixels by less than 2 of them, and one in a hundred by 6 (quality 95) to 12 (75) where chroma is halved.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from heatsplat.contracts import SceneError, counted
from heatsplat.datamodules.formats.images import PSEUDO_COLOUR_LEVELS, colour_levels
from heatsplat.datamodules.formats.palette import PERCEIVED, Palette, known

log = logging.getLogger(__name__)

SAMPLES, BLOCK = 512, 8  # of a palette's curve, and of them that are taken together in looking for a second place
FAR_BLOCKS = 6  # apart, so many make two places of the curve two temperatures: a tenth of the scale
PER_UNIT = 4  # steps in which distances are kept; the largest that can be is 63
CHUNK = 1024  # colours at a time: 2 MB of distances

# Farther than OFF from the curve is what is drawn over a picture, and what lies beside an edge that JPEG has blurred. Luma and
# chroma of the latter are those of levels within AROUND pixels, but for SLACK, only not together. The former is left out and
# what it has blurred: what is farther than BESIDE within REACH pixels.
OFF, AROUND, SLACK = 14.0, 4, 8.0
BESIDE, REACH = 5.0, 2
MOST_OFF = 0.5  # share of an image that may be so
MOST_MEDIAN = 6.0  # median distance of an image in another palette; of one in its own it is up to 3
# A second place is as good where it is farther by less than this, and than so many times the image's median distance more.
MARGIN, MARGIN_MEDIANS = 2.0, 2.0
# Rounds in which places are chosen by neighbours: those in so many pixels across, of which so many must be certain.
ROUNDS, WINDOW, FEWEST = 8, 5, 5
SURE = 0.5  # share of the distance (in levels) of one place from the neighbours' mean that the other's must be below
# Pictures that are nearer than GOOD_FIT to their palette on average are in it; others are in another one that is nearer than
# RIVAL of that. Of each picture every so many rows and columns are looked at, and of all pictures so many pixels.
GOOD_FIT, RIVAL = 1.0, 0.5
THINNED, MOST_LOOKED_AT = (7, 13), 2000
ALIKE = 6.0  # distance up to which two colours of a palette are one, in a JPEG
MOST_ALIKE = 0.5  # share of a palette's levels that have the colour of others, above which it tells nothing


@dataclass(frozen=True)
class Fit:
    """How well a picture fits its palette.

    Args:
        pixels: that the picture has.
        off: of those that count, in none of the palette's colours and beside no edge.
        undecided: of those that count, in colours of two levels, of which neighbours tell neither.
        distance: median distance of the others from the palette.
    """

    pixels: int
    off: int
    undecided: int
    distance: float

    @property
    def left_out(self) -> float:
        """Share of the pixels that are left out."""
        return (self.off + self.undecided) / self.pixels


@dataclass(frozen=True)
class Levels:
    """A picture as levels.

    Args:
        levels: [H, W] uint8, 0 at the cold end of the palette and 255 at the hot one.
        known: [H, W] bool, True where the level is known.
        fit: how well it fits.
    """

    levels: np.ndarray
    known: np.ndarray
    fit: Fit


class PaletteReader:
    """Tells levels from colours, each distinct colour of a scene once.

    Args:
        palette: of the pictures.

    Raises:
        SceneError: most levels of the palette have colours that others have, too.
    """

    def __init__(self, palette: Palette) -> None:
        self.palette = palette
        colours = palette.curve(SAMPLES)
        self._middle = (colours @ PERCEIVED).mean(axis=0)
        self._curve = (colours @ PERCEIVED - self._middle).astype(np.float32)
        found = palette.curve(256)
        self._spreads = found.max(axis=1) - found.min(axis=1)
        self._ranges = _ranges(found @ PERCEIVED)
        # By colour, once it is known: level, distance + 1, second level, its distance + 1, each of 8 bits; 0 before. Pages of
        # memory that no colour falls into are never touched.
        self._table = np.zeros(1 << 24, np.uint32)
        self._seen: list[np.ndarray] = []  # some pixels of each picture
        self.alike = self._alike(colours)
        if self.alike.mean() > MOST_ALIKE:
            raise SceneError(
                f"{palette.key}: {100 * self.alike.mean():.0f} % of the levels of {palette.name} have colours of other levels, "
                "too, so that its pictures tell no temperatures; train on the colours (data.thermal_channels=3, no °C)"
            )

    def _alike(self, colours: np.ndarray) -> np.ndarray:
        """Which samples of the curve have the colour of another place, too, but for ``ALIKE``."""
        _, nearest, _, second = self._places((colours @ PERCEIVED - self._middle).astype(np.float32))
        return second.astype(np.int16) - nearest <= ALIKE * PER_UNIT

    def note(self) -> str:
        """The palette in words, and how much of it is ambiguous."""
        said = self.palette.name
        if share := float(self.alike.mean()):
            at = np.flatnonzero(self.alike) / (SAMPLES - 1)
            said += (
                f"; {100 * share:.2g} % of its levels, between {100 * at.min():.0f} and {100 * at.max():.0f} % of the scale, "
                "have colours of other levels, too, and neighbouring pixels tell which"
            )
        return said

    def doubt(self) -> str:
        """Which known palette fits the pictures that were read much better than their own, in words; empty where none does."""
        seen = np.concatenate([np.zeros((0, 3), np.uint8), *self._seen])
        some = seen[:: max(1, len(seen) // MOST_LOOKED_AT)] @ PERCEIVED
        own = _misfit(some, self._curve + self._middle)
        if own <= GOOD_FIT:
            return ""
        fits = {palette.name: _misfit(some, palette.curve(128) @ PERCEIVED) for palette in known()}
        best = min(fits, key=fits.get)
        if fits[best] >= RIVAL * own:
            return ""
        return (
            f"the images fit the palette {best} much better (their colours lie {fits[best]:.1f} of 256 from it on average, and "
            f"{own:.1f} from {self.palette.name}); if that is theirs, give {self.palette.key}={best}, or {best}_r if its cold "
            "end is the other one"
        )

    def read(self, pixels: np.ndarray, counts: np.ndarray | None, name: str) -> Levels:
        """The levels of a picture.

        Args:
            pixels: [H, W, 3] or [H, W], uint8.
            counts: [H, W] bool, which pixels the picture is judged by; None for all.
            name: of the picture, for messages.

        Raises:
            SceneError: the picture has more than 8 bits, or is in grey, or mostly in colours that the palette has not.
        """
        if pixels.dtype != np.uint8:
            kind = "floating point" if pixels.dtype.kind == "f" else f"{8 * pixels.dtype.itemsize} bits"
            raise SceneError(
                f"image {name} is of {kind}, and pseudo-colour has 8 bits: its values are no colours of a palette; leave "
                f"{self.palette.key} out"
            )
        if pixels.ndim == 2:
            pixels = np.repeat(pixels[..., None], 3, axis=2)
        some = (slice(None, None, THINNED[0]), slice(None, None, THINNED[1]))
        self._seen.append(pixels[some].reshape(-1, 3) if counts is None else pixels[some][counts[some]])
        level, nearest, second_level, second = self._look_up(pixels)
        judged = np.ones(level.shape, dtype=bool) if counts is None else counts
        if judged.any():
            self._check(pixels, nearest, level, judged, name)
        off = nearest > OFF * PER_UNIT
        if off.any():
            drawn = self._drawn(pixels, level, off)
            near = cv2.dilate(drawn.astype(np.uint8), np.ones((2 * REACH + 1, 2 * REACH + 1), np.uint8)) > 0
            off = drawn | (near & (nearest > BESIDE * PER_UNIT))
        fits = ~off
        distance = _median(np.bincount(nearest[fits], minlength=256)) / PER_UNIT
        margin = PER_UNIT * (MARGIN + MARGIN_MEDIANS * distance)
        doubtful = fits & (second - np.minimum(second, nearest) <= margin)
        levels, sure = level, fits
        if doubtful.any():
            levels, sure = _chosen(level, second_level, fits & ~doubtful, doubtful)
        if sure.any() and not sure.all():
            levels = np.where(sure, levels, np.uint8(_median(np.bincount(levels[sure], minlength=256))))
        undecided = int((fits & ~sure & judged).sum())
        if undecided > MOST_OFF * judged.sum():
            raise SceneError(
                f"image {name}: {100 * undecided / judged.sum():.0f} % of its pixels have colours that {self.palette.name} has "
                "at two levels; export the images in another palette, or greys, or mask out what is in these colours (masks/)"
            )
        return Levels(levels, sure, Fit(levels.size, int((off & judged).sum()), undecided, distance))

    def _check(self, pixels: np.ndarray, nearest: np.ndarray, level: np.ndarray, judged: np.ndarray, name: str) -> None:
        """Raises SceneError where a picture is in another palette, or in grey."""
        own = colour_levels(pixels if judged.all() else pixels[judged][None])
        expected = float(self._spreads @ np.bincount(level[judged], minlength=256)) / judged.sum()
        distances = np.bincount(nearest[judged], minlength=256)
        off = float(distances[int(OFF * PER_UNIT) + 1 :].sum() / distances.sum())
        median = _median(distances) / PER_UNIT
        if (
            own <= PSEUDO_COLOUR_LEVELS
            and max(expected, self._spreads.mean() * (off > MOST_OFF)) > 3.0 * PSEUDO_COLOUR_LEVELS
        ):
            raise SceneError(
                f"image {name} is grey, and {self.palette.name} is not: leave {self.palette.key} out for greys, and keep "
                "pictures in grey and in colours in scenes of their own"
            )
        if off <= MOST_OFF and median <= MOST_MEDIAN:
            return
        others = _fitting(pixels[judged])
        raise SceneError(
            f"image {name} is not in the colours of {self.palette.name}: {100 * off:.0f} % of its pixels are far from all of "
            f"them (median distance {median:.0f} of 256; {OFF:g} is far, and pictures in their own palette have 0 to 3). {others}"
            f"Give the palette of the images ({self.palette.key}=bar.png: their colour bar alone, cut out of one of them), leave "
            "out images of another kind and those with edges of a photo drawn into them (MSX), or train on the colours as they "
            "are (data.thermal_channels=3 without data.palette, no °C)"
        )

    def _look_up(self, pixels: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Level, distance * PER_UNIT, second level and its distance, each [H, W] uint8."""
        codes = pixels[..., 0].astype(np.uint32) << 8
        codes = (codes | pixels[..., 1]) << 8 | pixels[..., 2]
        found = self._table[codes]
        if not found.all():
            new = np.unique(codes[found == 0])
            for start in range(0, len(new), CHUNK):
                some = new[start : start + CHUNK]
                colours = np.stack([some >> 16, some >> 8 & 255, some & 255], axis=1).astype(np.float64)
                places = self._places((colours @ PERCEIVED - self._middle).astype(np.float32))
                # Threads that meet the same new colour write the same number.
                self._table[some] = np.stack(places, axis=1).view("<u4")[:, 0]
            found = self._table[codes]
        parts = found.astype("<u4", copy=False).view(np.uint8).reshape(*found.shape, 4)
        level, nearest, second_level, second = (np.ascontiguousarray(parts[..., i]) for i in range(4))
        return level, nearest - np.uint8(1), second_level, second - np.uint8(1)

    def _drawn(self, pixels: np.ndarray, level: np.ndarray, off: np.ndarray) -> np.ndarray:
        """Which of the pixels [H, W] that are off have a luma or chroma that no level has between the lowest and the highest
        around them: what is drawn over the picture, and no blurred edge."""
        window = np.ones((2 * AROUND + 1, 2 * AROUND + 1), np.uint8)
        low = cv2.erode(np.where(off, np.uint8(255), level), window)[off]
        high = cv2.dilate(np.where(off, np.uint8(0), level), window)[off]
        colours = pixels[off] @ PERCEIVED
        least, most = self._ranges
        inside = (colours >= least[low, high] - SLACK) & (colours <= most[low, high] + SLACK)
        drawn = off.copy()
        drawn[off] = (low > high) | ~inside.all(axis=1)
        return drawn

    def _places(self, colours: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Of colours [n, 3] the nearest level (0 .. 255), 1 + its distance * PER_UNIT (1 .. 255), and both of the nearest one
        that is far from that along the curve."""
        squares = _squares(colours, self._curve)
        blocks = squares.reshape(len(colours), -1, BLOCK)
        least = blocks.min(axis=2)
        rows = np.arange(len(colours))
        first = least.argmin(axis=1)
        apart = np.abs(np.arange(least.shape[1]) - first[:, None])
        other = np.where(apart >= FAR_BLOCKS, least, np.inf).argmin(axis=1)
        found = []
        for block in (first, other):
            at = block * BLOCK + blocks[rows, block].argmin(axis=1)
            distance = np.sqrt(np.maximum(squares[rows, at], 0.0))
            found += [np.rint(at * (255.0 / (SAMPLES - 1))), 1.0 + np.clip(np.rint(PER_UNIT * distance), 0, 254)]
        return tuple(part.astype(np.uint8) for part in found)


def _chosen(
    level: np.ndarray, second: np.ndarray, certain: np.ndarray, doubtful: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Levels [H, W] uint8 of which doubtful ones are those of two that are nearer to neighbours, and where they are known.

    Certainty spreads from certain pixels, two pixels a round; what lies between the two stays unknown.
    """
    values, certain = level.astype(np.float32), certain.copy()
    window = (WINDOW, WINDOW)
    for _ in range(ROUNDS):
        count = cv2.boxFilter(certain.astype(np.float32), -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        total = cv2.boxFilter(values * certain, -1, window, normalize=False, borderType=cv2.BORDER_CONSTANT)
        mean = total / np.maximum(count, 1.0)
        here, there = np.abs(values - mean), np.abs(second - mean)
        decided = doubtful & ~certain & (count >= FEWEST) & (np.minimum(here, there) < SURE * np.maximum(here, there))
        if not decided.any():
            break
        values = np.where(decided & (there < here), second.astype(np.float32), values)
        certain |= decided
    return values.astype(np.uint8), certain


def _misfit(colours: np.ndarray, curve: np.ndarray) -> float:
    """Mean distance of colours [n, 3] from a curve, of which more than OFF counts as OFF; 0 of none."""
    if not len(colours):
        return 0.0
    return float(np.sqrt(np.clip(_squares(colours, curve).min(axis=1), 0.0, OFF**2)).mean())


def _squares(colours: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """Squared distances [n, N] of colours [n, 3] from samples [N, 3] of a curve; rounding may leave them below 0."""
    squares = (curve**2).sum(axis=1) - 2.0 * colours @ curve.T
    squares += (colours**2).sum(axis=1)[:, None]
    return squares


def _ranges(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest of values [n, C] from one to another [n, n, C]."""
    least = np.zeros((len(values), *values.shape), np.float32)
    most = least.copy()
    for first in range(len(values)):
        least[first, first:] = np.minimum.accumulate(values[first:], axis=0)
        most[first, first:] = np.maximum.accumulate(values[first:], axis=0)
    return least, most


def _median(counts: np.ndarray) -> float:
    """Median of small whole numbers of which there are so many each; 0 of none."""
    return float(np.searchsorted(np.cumsum(counts), counts.sum() / 2.0)) if counts.any() else 0.0


def _fitting(pixels: np.ndarray) -> str:
    """Which known palette fits pixels [n, 3] best, in words; empty where none does."""
    some = pixels[:: max(1, len(pixels) // 1000)].astype(np.float64) @ PERCEIVED
    best, least = "", MOST_MEDIAN / 2
    for palette in known():
        curve = palette.curve(128) @ PERCEIVED
        distance = float(np.sqrt(np.maximum(np.median(_squares(some, curve).min(axis=1)), 0.0)))
        if distance < least:
            best, least = palette.name, distance
    return f"{best} fits ({least:.1f}; {best}_r if its cold end is the other one). " if best else ""


def palette_notes(reader: PaletteReader, fits: Mapping[str, Fit]) -> dict[str, Any]:
    """What the pictures of a scene have in common, for its notes; pixels that are left out are told.

    Args:
        reader: of their palette.
        fits: of each by its name, one or more.
    """
    notes: dict[str, Any] = {"palette": reader.note()}
    if reader.alike.any():
        log.warning("%s: %s", reader.palette.key, notes["palette"])
    notes["palette_distance"] = (
        f"{np.median([fit.distance for fit in fits.values()]):.2g} of 256 (median; JPEG of quality 75 has 1 to 3)"
    )
    if doubt := reader.doubt():
        notes["palette_doubted"] = doubt
        log.warning("%s", doubt)
    worst = max(fits, key=lambda name: fits[name].left_out)
    if most := fits[worst].left_out:
        mean = float(np.mean([fit.left_out for fit in fits.values()]))
        undecided = sum(fit.undecided > 0 for fit in fits.values())
        notes["palette_left_out"] = (
            f"{100 * mean:.2g} % of the pixels are in no colour of the palette and left out (text, marks), at most "
            f"{100 * most:.2g} % ({worst})"
            + (f"; some of {counted(undecided, 'image')} are in colours of two levels" if undecided else "")
        )
        log.info("%s", notes["palette_left_out"])
    return notes
