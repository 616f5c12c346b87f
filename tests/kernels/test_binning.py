"""Binning against a comparison of every pixel with every Gaussian: nothing is missing, the order is that of depth."""

import numpy as np
import pytest
import torch

from heatsplat.kernels.constants import ALPHA_MAX, ALPHA_MIN, BLOCK, TILE, TILE_BLOCKS, TRANSMITTANCE_MIN
from heatsplat.renderers import base
from heatsplat.renderers.base import RenderInputs
from heatsplat.renderers.cpu import _Frame
from heatsplat.training.rng import generator_for

WIDTH, HEIGHT = 83, 71  # no whole number of tiles or blocks


def binned(count: int, longest: float, seed: int) -> tuple[_Frame, np.ndarray]:
    """A binned frame of Gaussians up to ``longest`` pixels, two of each at the same depth; and their opacities."""
    generator = generator_for(seed, 0, "binning")
    means = torch.rand(count, 3, generator=generator) * torch.tensor([3.0, 3.0, 4.0]) + torch.tensor([-1.5, -1.5, 1.0])
    means[1::2, 2] = means[::2, 2]
    scales = torch.rand(count, 3, generator=generator).pow(4) * longest / 80 + 1e-4
    opacities = torch.rand(1, count, generator=generator)
    K = torch.tensor([[60.0, 0, 40], [0, 66, 30], [0, 0, 1]])
    quats = torch.randn(count, 4, generator=generator)
    features = torch.rand(count, 1, generator=generator)
    frame = _Frame(
        RenderInputs(
            means, quats, scales, opacities, features, torch.eye(4), K, WIDTH, HEIGHT, 0.01, 1e10, None, False, None,
            False, False,
        )
    )  # fmt: skip
    frame.bin((1,), frame.project(), features)
    return frame, opacities[0].numpy()


def reached(frame: _Frame, gaussian: int) -> np.ndarray:
    """log2 of the alpha of a Gaussian at every pixel, [H, W] float64, from its row of ``screen``."""
    mean_x, mean_y, first, mixed, second, log_opacity = frame.screen[gaussian, :6].astype(np.float64)
    x, y = np.arange(WIDTH) + 0.5 - mean_x, np.arange(HEIGHT)[:, None] + 0.5 - mean_y
    return log_opacity - (first * x + mixed * y) ** 2 - (second * y) ** 2


def blocks_of(frame: _Frame, gaussian: int) -> np.ndarray:
    """The blocks in which a Gaussian is listed, [rows of blocks, columns of blocks] bool over all tiles."""
    listed = np.zeros((frame.tiles_y * TILE_BLOCKS, frame.tiles_x * TILE_BLOCKS), bool)
    rank = int(np.flatnonzero(frame.ids == gaussian)[0])
    for tile in range(frame.tiles_x * frame.tiles_y):
        here = frame.instances[frame.tile_starts[tile] : frame.tile_starts[tile + 1]]
        for mask in here[(here[:, 0] & 0xFFFFFFFF) == rank, 1]:
            bits = np.unpackbits(np.array([mask], np.int64).view(np.uint8), bitorder="little").reshape(8, 8)
            row, column = tile // frame.tiles_x * TILE_BLOCKS, tile % frame.tiles_x * TILE_BLOCKS
            listed[row : row + TILE_BLOCKS, column : column + TILE_BLOCKS] |= bits.astype(bool)
    return listed


@pytest.mark.parametrize("longest", [2.0, 40.0, 400.0])
def test_every_block_that_a_gaussian_reaches_is_listed_and_few_others(longest):
    frame, _ = binned(120, longest, seed=int(longest))
    listed, needed = 0, 0
    for gaussian in frame.ids:
        exponent = reached(frame, gaussian)
        pixels = np.zeros((frame.tiles_y * TILE, frame.tiles_x * TILE), bool)
        pixels[:HEIGHT, :WIDTH] = exponent >= np.log2(1 / 255)
        blocks = pixels.reshape(-1, BLOCK, frame.tiles_x * TILE_BLOCKS, BLOCK).any(axis=(1, 3))
        found = blocks_of(frame, gaussian)
        assert not (blocks & ~found).any()
        listed, needed = listed + found.sum(), needed + blocks.sum()
    assert needed <= listed <= 1.35 * needed  # an ellipse may cross a block between its pixels


def test_tiles_list_gaussians_front_to_back_and_equal_depths_by_index():
    frame, _ = binned(400, 40.0, seed=1)
    depths = frame.screen[frame.ids, 6]
    assert (np.diff(depths) >= 0).all()
    ties = np.flatnonzero(np.diff(depths) == 0)
    assert len(ties) > 50 and (frame.ids[ties] < frame.ids[ties + 1]).all()
    for tile in range(frame.tiles_x * frame.tiles_y):
        ranks = frame.instances[frame.tile_starts[tile] : frame.tile_starts[tile + 1], 0] & 0xFFFFFFFF
        assert (np.diff(ranks) > 0).all()


def test_gradient_slots_are_numbered_gaussian_by_gaussian():
    frame, _ = binned(400, 40.0, seed=2)
    count = frame.tile_starts[-1]
    ranks, slots = frame.instances[:count, 0] & 0xFFFFFFFF, frame.instances[:count, 0] >> 32
    assert sorted(slots) == list(range(count))
    for rank, slot in zip(ranks, slots, strict=True):
        first, after = frame.spans[frame.ids[rank]]
        assert first <= slot < after


def test_kernels_and_other_backends_share_their_constants():
    assert np.float32(base.ALPHA_MIN) == ALPHA_MIN
    assert np.float32(base.ALPHA_MAX) == ALPHA_MAX
    assert np.float32(base.TRANSMITTANCE_MIN) == TRANSMITTANCE_MIN
