"""How sharp the frames of a recording are beside each other, and which of neighbours is the sharpest.

The doctor measures otherwise (``doctor.checks.sharpness``): what it has falls further with blur, but tells frames that look at
unlike parts of a scene half as well apart. Motion of 3 pixels is 1.6 standard deviations of it, and 3.2 of this one.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

import cv2
import numpy as np
from rich.progress import track

from heatsplat.preparation.devices import devices_of
from heatsplat.preparation.frame import ThermalFrame

# Pixels of the means whose gradients are compared: noise is a small part of the finer ones, and blur hardly touches the coarser.
FINE, COARSE = 2, 8


def sharpness(pixels: np.ndarray) -> float:
    """How strong fine gradients of a picture [H, W] are beside its coarse ones (root mean square); 0 where it shows nothing.

    The scene in view is in both, so frames that look at unlike parts of it can be compared. A median over 3 x 3 pixels takes out
    dead ones first, which are sharp in every frame. Unknown pixels (NaN) count as the median of the others.
    """
    known = np.isfinite(pixels)
    if not known.any():
        return 0.0
    filled = np.where(known, pixels, np.median(pixels[known])).astype(np.float32)
    clean = cv2.medianBlur(filled - filled.mean(), 3)
    fine, coarse = (_energy(cv2.blur(clean, (size, size))) for size in (FINE, COARSE))
    return float(np.sqrt(fine / coarse)) if coarse > 0 else 0.0


def _energy(picture: np.ndarray) -> float:
    """Sum of the squared differences between neighbours."""
    return float(sum(np.square(np.diff(picture, axis=axis), dtype=np.float64).sum() for axis in (0, 1)))


def sharpest(frames: Sequence[ThermalFrame], every: int) -> tuple[list[ThermalFrame], str]:
    """Of each camera the sharpest of each ``every`` frames in a row, in the order of ``frames``, and what it gained in words."""
    sharp = {frame.name: sharpness(frame.load()) for frame in track(frames, "sharpness")}
    taken, gains = set(), []
    for device in devices_of(frames):
        for first in range(0, len(device.frames), every):
            values = [sharp[frame.name] for frame in device.frames[first : first + every]]
            taken.add(device.frames[first + int(np.argmax(values))].name)
            gains += [max(values) / values[0]] if values[0] > 0 else []
    gained = f"{median(gains):.2f} times as sharp as the first in the median, at most {max(gains):.2f}" if gains else ""
    return [frame for frame in frames if frame.name in taken], gained or "none shows anything"
