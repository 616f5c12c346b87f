"""Hash grids against nodes that are looked up one by one."""

import itertools

import pytest
import torch

from heatsplat.geometry.hash_grid import interpolated, sizes


def directly(tables, cells, place):
    """The sum over the eight nodes of every grid, with Python's integers."""
    found = []
    entries = tables.shape[1]
    for table, count in zip(tables, cells, strict=True):
        below = [min(int(x * count), count - 1) for x in place]
        total = torch.zeros(tables.shape[2], dtype=tables.dtype)
        for corner in itertools.product((0, 1), repeat=3):
            node = [low + up for low, up in zip(below, corner, strict=True)]
            weight = 1.0
            for x, low, up in zip(place, below, corner, strict=True):
                share = x * count - low
                weight *= share if up else 1 - share
            if (count + 1) ** 3 <= entries:
                row = node[0] + node[1] * (count + 1) + node[2] * (count + 1) ** 2
            else:
                row = (node[0] ^ (node[1] * 2654435761 % 2**32) ^ (node[2] * 805459861 % 2**32)) % entries
            total += weight * table[row]
        found.append(total)
    return torch.cat(found)


def test_features_are_those_of_the_eight_nodes_looked_up_one_by_one():
    generator = torch.Generator().manual_seed(0)
    cells = (3, 7, 500)  # 64 and 512 nodes have room, 501³ share
    tables = torch.randn(3, 512, 2, generator=generator, dtype=torch.float64)
    places = torch.cat(
        (torch.rand(20, 3, generator=generator), torch.tensor([[0.0, 0, 0], [1.0, 1, 1], [1.0, 0.5, 0]]))
    )
    found = interpolated(tables, cells, places.double())
    expected = torch.stack([directly(tables, cells, place) for place in places.double().tolist()])
    assert torch.allclose(found, expected, atol=1e-9)


def test_the_gradient_of_an_entry_is_the_weight_with_which_it_is_read():
    tables = torch.zeros(1, 8, 1, dtype=torch.float64, requires_grad=True)  # one cell, whose eight nodes have room
    interpolated(tables, (1,), torch.tensor([[0.25, 0.5, 0.125]], dtype=torch.float64)).sum().backward()
    assert tables.grad[0, :, 0].tolist() == pytest.approx(
        [x * y * z for z in (0.875, 0.125) for y in (0.5, 0.5) for x in (0.75, 0.25)]
    )


def test_grids_grow_by_equal_factors():
    assert sizes(8, 16, 2048) == [16, 32, 64, 128, 256, 512, 1024, 2048]
    assert sizes(3, 10, 30) == [10, 17, 30] and sizes(1, 16, 512) == [16]
