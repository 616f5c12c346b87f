"""SPZ read back by what its published description says (version 3), not by our own code."""

import gzip
import struct

import numpy as np
import torch

from heatsplat.export.formats.spz import Spz
from heatsplat.export.place import upright
from heatsplat.geometry.rotations import quats_to_matrices
from heatsplat.geometry.spherical_harmonics import C0
from heatsplat.io.pictures import colorize


def read(path):
    """Positions, opacities, colours in [0, 1], sizes and rotations (wxyz): 16 bytes of header, then one array after the other."""
    content = gzip.decompress(path.read_bytes())
    magic, version, count, degree, bits, flags, reserved = struct.unpack_from("<4sIIBBBB", content)
    assert (magic, version, degree, reserved) == (b"NGSP", 3, 0, 0) and flags in (0, 1)
    assert len(content) == 16 + count * (9 + 1 + 3 + 3 + 4)
    data = np.frombuffer(content, np.uint8, offset=16)
    places, alphas, colours, sizes, rotations = np.split(data, np.cumsum([9 * count, count, 3 * count, 3 * count]))
    low, middle, high = places.reshape(-1, 3).astype(np.int64).T
    fixed = low | middle << 8 | high << 16
    fixed = np.where(fixed >= 1 << 23, fixed - (1 << 24), fixed).reshape(-1, 3)
    quats = np.zeros((count, 4))
    for row, word in zip(quats, rotations.view("<u4").tolist(), strict=True):
        largest, rest = word >> 30, 0.0
        for i in (3, 2, 1, 0):
            if i != largest:
                row[i] = (word & 511) / 511 / 2**0.5 * (-1 if word & 512 else 1)
                rest += row[i] ** 2
                word >>= 10
        row[largest] = max(0.0, 1 - rest) ** 0.5
    linear = ((colours.reshape(-1, 3) / 255) - 0.5) / 0.15  # coefficients of degree 0
    return (
        fixed / 2**bits,
        alphas / 255,
        0.5 + C0 * linear,
        np.exp(sizes.reshape(-1, 3) / 16 - 10),
        np.roll(quats, 1, 1),
    )


def test_the_description_reads_what_was_written(cooling, tmp_path):
    Spz(range_c=[20.0, 40.0]).write(cooling, tmp_path / "a.spz")
    means, opacities, colours, scales, quats = read(tmp_path / "a.spz")
    own_means, own_quats, own_scales = upright(cooling)
    assert np.abs(means - own_means.numpy()).max() < 2**-16
    assert np.abs(opacities - cooling.seen.opacities.numpy()).max() <= 0.5 / 255 + 1e-6
    shown = colorize(cooling.values[:, None], 20.0, 40.0)[:, 0] / 255
    assert np.abs(colours - shown).max() < 0.5 / 255 / 0.15 * C0 + 1e-3
    assert np.allclose(np.log(scales), np.log(own_scales.numpy()), atol=1 / 32 + 1e-6)
    turned = quats_to_matrices(torch.from_numpy(quats)) - quats_to_matrices(own_quats.double())
    assert turned.abs().max() < 0.006  # nine bits and a sign


def test_the_same_moment_gives_the_same_file_and_a_small_one(cooling, tmp_path):
    for name in ("a", "b"):
        Spz().write(cooling, tmp_path / f"{name}.spz")
    content = (tmp_path / "a.spz").read_bytes()
    assert content == (tmp_path / "b.spz").read_bytes()
    assert len(content) < 21 * len(cooling.values)
