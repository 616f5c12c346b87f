"""Trilinear interpolation between the nodes of grids that share tables, and the gradient of the tables.

The plain-torch twin is heatsplat.geometry.hash_grid.interpolated_reference, which says what is computed.

The table of one grid fits into the second-level cache, all of them do not: a block of places goes through grid after grid.
An entry has two numbers, as those of instant-ngp do: a loop over any number of them takes twice as long. In the gradient
each grid's table is one thread's, which adds to it place after place: the number of threads changes no bit.
"""

from __future__ import annotations

import numpy as np

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.scheduling import parallel_for
from heatsplat.kernels.simd import load_scalar, store_scalar

BLOCK = 2048  # places per parallel task
CORNERS = 8

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)
PRIME_Y, PRIME_Z = 2654435761, 805459861  # π_2 and π_3 (Müller et al. 2022, Eq. 4)


@inline
def _node(place, axis, places, count):
    """The node below a place along an axis of a grid of ``count`` cells, and how far beyond it the place lies, in cells."""
    scaled = places[place, axis] * np.float32(count)
    if not scaled > _ZERO:  # NaN, too, which is beyond no node
        return 0, scaled
    below = min(np.int64(min(scaled, np.float32(count))), count - 1)
    return below, scaled - np.float32(below)


@inline
def _weight(corner, u, v, w):
    """The weight with which one of the eight nodes around a place is read."""
    along_x = u if corner & 1 else _ONE - u
    along_y = v if corner & 2 else _ONE - v
    return along_x * along_y * (w if corner & 4 else _ONE - w)


@inline
def _row(corner, x, y, z, count, entries, dense):
    """The row of a table that holds one of the eight nodes around a place."""
    i, j, k = x + (corner & 1), y + (corner >> 1 & 1), z + (corner >> 2)
    if dense:
        return i + (count + 1) * (j + (count + 1) * k)
    return (i ^ (j * PRIME_Y) ^ (k * PRIME_Z)) & (entries - 1)


@inline
def _interpolate_block(block, tables, cells, places, found):
    """Writes a block of places."""
    entries = tables.shape[1]
    for level in range(tables.shape[0]):
        count = cells[level]
        dense = (count + 1) ** 3 <= entries
        for place in range(block * BLOCK, min((block + 1) * BLOCK, places.shape[0])):
            x, u = _node(place, 0, places, count)
            y, v = _node(place, 1, places, count)
            z, w = _node(place, 2, places, count)
            first, second = _ZERO, _ZERO
            for corner in range(CORNERS):
                weight, row = _weight(corner, u, v, w), _row(corner, x, y, z, count, entries, dense)
                node = 2 * (level * entries + row)
                first += weight * load_scalar(tables, node)
                second += weight * load_scalar(tables, node + 1)
            at = 2 * (place * tables.shape[0] + level)
            store_scalar(found, at, first)
            store_scalar(found, at + 1, second)


@kernel
def interpolate(tables, cells, places, found):
    """Fills ``found``.

    Args:
        tables: [L, T, 2] float32; T a power of two.
        cells: [L] int64 along an axis of each grid.
        places: [n, 3] float32 in [0, 1]³.
        found: [n, 2 L] output.
    """
    blocks = (places.shape[0] + BLOCK - 1) // BLOCK
    parallel_for(_interpolate_block, blocks, (tables, cells, places, found))


@inline
def _differentiate_level(level, cells, places, grad, v_tables):
    """Writes the gradient of a table."""
    entries, count = v_tables.shape[1], cells[level]
    dense = (count + 1) ** 3 <= entries
    first_row = level * entries
    for row in range(first_row, first_row + entries):
        store_scalar(v_tables, 2 * row, _ZERO)
        store_scalar(v_tables, 2 * row + 1, _ZERO)
    for place in range(places.shape[0]):
        x, u = _node(place, 0, places, count)
        y, v = _node(place, 1, places, count)
        z, w = _node(place, 2, places, count)
        at = 2 * (place * v_tables.shape[0] + level)
        first, second = load_scalar(grad, at), load_scalar(grad, at + 1)
        for corner in range(CORNERS):
            weight, row = _weight(corner, u, v, w), _row(corner, x, y, z, count, entries, dense)
            node = 2 * (first_row + row)
            store_scalar(v_tables, node, load_scalar(v_tables, node) + weight * first)
            store_scalar(v_tables, node + 1, load_scalar(v_tables, node + 1) + weight * second)


@kernel
def differentiate(cells, places, grad, v_tables):
    """Fills the gradient of ``interpolate`` in the tables.

    Args:
        cells, places: as for ``interpolate``.
        grad: [n, 2 L] gradient of what was found.
        v_tables: [L, T, 2] output.
    """
    parallel_for(_differentiate_level, v_tables.shape[0], (cells, places, grad, v_tables))
