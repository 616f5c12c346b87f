"""SPZ, Niantic's packed splats: a fifth to a quarter of a PLY."""

from __future__ import annotations

import gzip
import math
import struct
from pathlib import Path

import numpy as np

from heatsplat.export.formats.base import Coloured
from heatsplat.export.moment import Moment
from heatsplat.export.place import upright
from heatsplat.geometry.spherical_harmonics import C0

MAGIC, VERSION = 0x5053474E, 3  # the last version that is plain gzip; readers of version 4 read it, too
PLACES = 2**23 - 1  # of a coordinate of 24 bits, to each side
MOST_FRACTION = 16  # bits of a coordinate behind the point
COLOUR_SCALE = 0.15
STEPS = 511  # of a component of a rotation, to each side


class Spz(Coloured):
    """Gaussians coloured at a moment, y up; colours, opacities and sizes in 8 bits, without temperatures.

    Args:
        colormap, range_c: as in ``Coloured``.
    """

    suffix = ".spz"
    from_origin = False

    def write(self, moment: Moment, path: Path) -> None:
        means, quats, scales = (values.double().numpy() for values in upright(moment))
        opacities = self.opacities(moment).numpy()
        colours = (self.colours(moment) - 0.5) / C0
        largest = float(np.abs(means).max())
        bits = int(min(MOST_FRACTION, math.floor(math.log2(PLACES / max(largest, 1e-9)))))
        if bits < 1:
            bits, means = 1, means.clip(-PLACES / 2, PLACES / 2)
        places = np.round(means * 2**bits).astype("<i4").reshape(-1, 1).view(np.uint8).reshape(-1, 4)[:, :3]
        parts = (
            places,
            _bytes(opacities * 255),
            _bytes((colours * COLOUR_SCALE + 0.5) * 255),
            _bytes((np.log(scales.clip(min=1e-30)) + 10) * 16),
            _smallest_three(quats),
        )
        header = struct.pack(
            "<IIIBBBB", MAGIC, VERSION, len(means), 0, bits, int(moment.module.renderer.antialiased), 0
        )
        path.write_bytes(gzip.compress(header + b"".join(part.tobytes() for part in parts), mtime=0))


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.round(values).clip(0, 255).astype(np.uint8)


def _smallest_three(quats: np.ndarray) -> np.ndarray:
    """Rotations [n, 4] wxyz as 32 bits: which component (xyzw) is largest, and the others in its sign."""
    xyzw = np.roll(quats, -1, axis=1)
    largest = np.abs(xyzw).argmax(1)
    xyzw = xyzw * np.where(np.take_along_axis(xyzw, largest[:, None], 1) < 0, -1, 1)
    packed = largest.astype("<u4")
    for i in range(4):
        size = np.floor(STEPS * np.abs(xyzw[:, i]) * math.sqrt(2) + 0.5).astype("<u4").clip(max=STEPS)
        packed = np.where(largest == i, packed, (packed << 10) | ((xyzw[:, i] < 0).astype("<u4") << 9) | size)
    return packed.astype("<u4")
