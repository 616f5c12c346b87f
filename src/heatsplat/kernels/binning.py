"""Which Gaussians touch which 4x4 pixel blocks of which tile, front to back.

A tile is 16x16 pixels, 16 blocks of 4x4; an instance is one Gaussian on one tile with the mask of the blocks it reaches.
Depths are sorted once per Gaussian, not once per instance; instances are then found front to back and dealt out to their
tiles in that order, so no tile ever sorts.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from heatsplat.kernels.compilation import inline, kernel, part, serial_kernel
from heatsplat.kernels.projection import (
    BOTTOM,
    DEPTH,
    FIRST,
    GEOMETRY,
    LEFT,
    LOG2_ALPHA_MIN,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    MIXED,
    RIGHT,
    SCREEN,
    SECOND,
    SLOPE_X,
    SLOPE_Y,
    TILE,
    TOP,
    feature_row,
)
from heatsplat.kernels.scheduling import take
from heatsplat.kernels.simd import bits, lane_indices, load, maximum, minimum, prefetch, store_first, to_float

RADIX_BITS = 11
BUCKETS = 1 << RADIX_BITS
SLABS = 8  # per thread; near slabs hold more instances than far ones
AHEAD = 16  # Gaussians ahead of use that rows are fetched
INSTANCE = 3  # numbers per instance of a tile: Gaussian, gradient slot, block mask

_ZERO, _HALF = np.float32(0.0), np.float32(0.5)
_SLACK = np.float32(1.001)  # more than the rounding of the exponent: the test may keep too much, never too little


@inline
def _touched_blocks(block_x, block_y, first, mixed, second, slope_x, slope_y, limit):
    """The blocks in which u1^2 + u2^2 falls below ``limit``: an exact ellipse-box test of sixteen blocks at once.

    The minimum over a box lies at its point next to the centre in x, with y free, or the other way round.

    Args:
        block_x, block_y: offsets of the blocks' first pixel centres from the mean.
        first, mixed, second: the whitening.
        slope_x, slope_y: dx of the smallest u1^2 + u2^2 per dy, and dy per dx.
    """
    right, bottom = block_x + np.float32(3.0), block_y + np.float32(3.0)
    near_x = maximum(minimum(right, _ZERO), block_x)
    near_y = maximum(minimum(bottom, _ZERO), block_y)
    free_y = maximum(minimum(slope_y * near_x, bottom), block_y)
    free_x = maximum(minimum(slope_x * near_y, right), block_x)
    u1, u2 = first * near_x + mixed * free_y, second * free_y
    w1, w2 = first * free_x + mixed * near_y, second * near_y
    return bits(minimum(u1 * u1 + u2 * u2, w1 * w1 + w2 * w2) <= limit)


@serial_kernel
def sort_by_depth(visible, depths, ids, keys, other_ids, other_keys, histogram):
    """Writes the ``visible`` ids into ``ids`` in order of depth, equal depths in order of index.

    A radix sort in three passes of eleven bits; the bit pattern of a positive float grows with the float.
    """
    count = visible.shape[0]
    for k in range(count):
        other_ids[k] = visible[k]
        other_keys[k] = depths[visible[k]]
    bit_keys, other_bit_keys = keys.view(np.uint32), other_keys.view(np.uint32)
    for radix_pass in range(3):
        shift = np.uint32(RADIX_BITS * radix_pass)
        for bucket in range(BUCKETS):
            histogram[bucket] = 0
        for k in range(count):
            histogram[(other_bit_keys[k] >> shift) & np.uint32(BUCKETS - 1)] += 1
        running = np.int64(0)
        for bucket in range(BUCKETS):
            running += histogram[bucket]
            histogram[bucket] = running - histogram[bucket]
        for k in range(count):
            bucket = (other_bit_keys[k] >> shift) & np.uint32(BUCKETS - 1)
            place = histogram[bucket]
            histogram[bucket] = place + 1
            bit_keys[place] = other_bit_keys[k]
            ids[place] = other_ids[k]
        ids, other_ids = other_ids, ids
        bit_keys, other_bit_keys = other_bit_keys, bit_keys


@inline
def _box(gaussian, screen):
    """The tiles of a Gaussian's bounding box: left, top, width, height."""
    left, top = np.int64(screen[gaussian, LEFT]), np.int64(screen[gaussian, TOP])
    return left, top, np.int64(screen[gaussian, RIGHT]) - left, np.int64(screen[gaussian, BOTTOM]) - top


@part
def _pack(rank, gaussian, screen, features, row, opacities, has_depth, records):
    """Writes the record of a Gaussian: what compositing reads of it, side by side (layout.Layout.record)."""
    store_first(records, rank * records.shape[1], load(screen, gaussian * SCREEN), GEOMETRY)
    field = GEOMETRY
    modalities, colours = opacities.shape[0], features.shape[1]
    if modalities > 1:
        largest = _ZERO
        for modality in range(modalities):
            largest = max(largest, opacities[modality, gaussian])
        for modality in range(modalities):
            records[rank, field + modality] = opacities[modality, gaussian] / largest
        field += modalities
    for channel in range(colours):
        records[rank, field + channel] = features[row, channel]
    if has_depth:
        records[rank, field + colours] = screen[gaussian, DEPTH]


@part
def _find(gaussian, screen, tiles_x, found, place, counts, slab):
    """Writes tile and mask of the instances of a Gaussian from ``place`` of ``found`` on; returns the place after them."""
    first, mixed, second = screen[gaussian, FIRST], screen[gaussian, MIXED], screen[gaussian, SECOND]
    slope_x, slope_y = screen[gaussian, SLOPE_X], screen[gaussian, SLOPE_Y]
    limit = (screen[gaussian, LOG_OPACITY] - LOG2_ALPHA_MIN) * _SLACK + np.float32(1e-4)
    left, top, width, height = _box(gaussian, screen)
    column = to_float((lane_indices() & 3) * 4) + (np.float32(left * TILE) + _HALF - screen[gaussian, MEAN_X])
    line = to_float((lane_indices() >> 2) * 4) + (np.float32(top * TILE) + _HALF - screen[gaussian, MEAN_Y])
    x, y = 0, 0
    for _ in range(width * height):  # one loop, as the ends of two short ones are hard to predict
        block_x, block_y = column + np.float32(x * TILE), line + np.float32(y * TILE)
        mask = _touched_blocks(block_x, block_y, first, mixed, second, slope_x, slope_y, limit)
        tile = (top + y) * tiles_x + left + x
        found[place, 0] = tile
        found[place, 1] = mask
        touched = np.int64(mask != 0)
        place += touched
        counts[slab, tile] += touched
        x += 1
        y += x == width
        x = x if x < width else 0
    return place


@kernel
def find_instances(
    workers, ids, screen, width, features, rows_are_ranks, first_ranks, opacities, has_depth, tickets,
    records, found, found_starts, found_counts, counts,
):  # fmt: skip
    """Packs the records of the visible Gaussians and tests these against the tiles of their bounding boxes.

    Args:
        ids: [n] visible Gaussians front to back; cut into slabs that threads take one after the other.
        screen: see ``projection.project``.
        features: [N, C], or [n, C] of the visible ones by ascending id where ``rows_are_ranks``.
        first_ranks: [chunks], how many visible Gaussians there are before a chunk.
        tickets: [2, 1] int64, zero.
        records: out [n, numbers], front to back.
        found: out, tile and mask of each instance, each slab's own side by side and front to back.
        found_starts: out [slabs], where those of a slab begin.
        found_counts: out [n], how many instances each Gaussian has.
        counts: out [slabs, tiles], how many instances of a slab are in a tile.
    """
    slabs, tile_count = counts.shape
    tiles_x = (width + TILE - 1) // TILE
    count = ids.shape[0]
    share = (count + slabs - 1) // slabs
    for _ in prange(workers):
        slab = take(tickets[0], 1)
        while slab < slabs:
            for tile in range(tile_count):
                counts[slab, tile] = 0
            bound = np.int64(0)
            for rank in range(slab * share, min(count, (slab + 1) * share)):
                prefetch(screen, np.int64(ids[min(rank + AHEAD, count - 1)]) * SCREEN)
                gaussian = np.int64(ids[rank])
                prefetch(features, feature_row(gaussian, screen, rows_are_ranks, first_ranks) * features.shape[1])
                box = _box(gaussian, screen)
                bound += box[2] * box[3]
            place = take(tickets[1], bound)
            found_starts[slab] = place
            for rank in range(slab * share, min(count, (slab + 1) * share)):
                gaussian = np.int64(ids[rank])
                row = feature_row(gaussian, screen, rows_are_ranks, first_ranks)
                _pack(rank, gaussian, screen, features, row, opacities, has_depth, records)
                first_place = place
                place = _find(gaussian, screen, tiles_x, found, place, counts, slab)
                found_counts[rank] = place - first_place
            slab = take(tickets[0], 1)


@kernel
def deal_to_tiles(
    workers, found, found_starts, found_counts, counts, ticket, slab_starts, slot_starts, tile_starts, instances
):
    """Deals the instances out to the tiles, front to back, and numbers them.

    Args:
        found, found_starts, found_counts, counts: what ``find_instances`` found; ``counts`` is overwritten.
        ticket: [1] int64, zero.
        slab_starts: scratch [slabs].
        slot_starts: out [n + 1], the first of the gradient slots of a Gaussian; its instances have consecutive ones.
        tile_starts: out [tiles + 1], the first instance of each tile.
        instances: out [instances, INSTANCE], tile by tile: rank of the Gaussian, gradient slot, block mask.
    """
    slabs, tile_count = counts.shape
    count = found_counts.shape[0]
    share = (count + slabs - 1) // slabs
    for slab in range(slabs):
        slab_starts[slab] = 0
    running = np.int64(0)
    for tile in range(tile_count):
        tile_starts[tile] = running
        for slab in range(slabs):
            here = counts[slab, tile]
            counts[slab, tile] = running
            slab_starts[slab] += here
            running += here
    tile_starts[tile_count] = running
    slot_starts[count] = running
    running = 0
    for slab in range(slabs):
        here = slab_starts[slab]
        slab_starts[slab] = running
        running += here
    for _ in prange(workers):
        slab = take(ticket, 1)
        while slab < slabs:
            slot = slab_starts[slab]
            place = found_starts[slab]
            for rank in range(slab * share, min(count, (slab + 1) * share)):
                slot_starts[rank] = slot
                for _instance in range(found_counts[rank]):
                    tile = found[place, 0]
                    target = counts[slab, tile]
                    counts[slab, tile] = target + 1
                    instances[target, 0] = rank
                    instances[target, 1] = slot
                    instances[target, 2] = found[place, 1]
                    slot += 1
                    place += 1
            slab = take(ticket, 1)
