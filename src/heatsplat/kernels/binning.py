"""Which Gaussians touch which 4x4 pixel blocks of which tile, front to back.

A tile is 16x16 pixels, 16 blocks of 4x4; an instance is one Gaussian on one tile with the mask of the blocks it reaches.
Two orders meet here. Instances are found in order of Gaussian index, where each Gaussian's gradient slots lie side by side
and its data is still in the cache; they are then dealt out to the tiles in order of depth. Depths are sorted once per
Gaussian, not once per instance, and dealing keeps the order, so no tile ever sorts.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from heatsplat.kernels.compilation import inline, kernel, serial_kernel
from heatsplat.kernels.projection import CHUNK, GEOMETRY, LOG2_ALPHA_MIN, TILE
from heatsplat.kernels.simd import (
    bits,
    lane_indices,
    maximum,
    minimum,
    to_float,
)

RADIX_BITS = 11
BUCKETS = 1 << RADIX_BITS
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


@kernel
def find_instances(
    geometry, rectangles, width, height, visible, visible_counts, first_slots, features, rows_are_ranks, first_ranks,
    opacities, depths, has_depth, records, tiles, masks, ranges,
):  # fmt: skip
    """Packs the records of the visible Gaussians and tests these against the tiles of their bounding boxes.

    Args:
        geometry, rectangles, depths, visible, visible_counts: see ``projection.project``.
        first_slots: [chunks], where the instances of a chunk begin.
        features: [N, C], or [n, C] of the visible ones where ``rows_are_ranks``.
        first_ranks: [chunks], how many visible Gaussians there are before a chunk.
        records: out [N, numbers], what compositing reads of a Gaussian (layout.Layout.record).
        tiles, masks: out, in order of Gaussian index; a chunk leaves a gap before the next one.
        ranges: out [N, 2], first instance of each visible Gaussian and the one after its last.
    """
    modalities, colours = opacities.shape[0], features.shape[1]
    tiles_x = (width + TILE - 1) // TILE
    column = to_float(lane_indices() & 3) * np.float32(4.0)
    line = to_float(lane_indices() >> 2) * np.float32(4.0)
    for chunk in prange(visible_counts.shape[0]):
        slot = first_slots[chunk]
        for position in range(visible_counts[chunk]):
            gaussian = np.int64(visible[chunk * CHUNK + position])
            for field in range(GEOMETRY):
                records[gaussian, field] = geometry[gaussian, field]
            field = GEOMETRY
            if modalities > 1:
                largest = _ZERO
                for modality in range(modalities):
                    largest = max(largest, opacities[modality, gaussian])
                for modality in range(modalities):
                    records[gaussian, field] = opacities[modality, gaussian] / largest
                    field += 1
            row = first_ranks[chunk] + position if rows_are_ranks else gaussian
            for channel in range(colours):
                records[gaussian, field + channel] = features[row, channel]
            if has_depth:
                records[gaussian, field + colours] = depths[gaussian]

            mean_x, mean_y = records[gaussian, 0], records[gaussian, 1]
            first, mixed, second = records[gaussian, 2], records[gaussian, 3], records[gaussian, 4]
            limit = (records[gaussian, 5] - LOG2_ALPHA_MIN) * _SLACK + np.float32(1e-4)
            slope_x = -mixed / first
            slope_y = -first * mixed / (mixed * mixed + second * second)
            ranges[gaussian, 0] = slot
            for tile_y in range(rectangles[gaussian, 2], rectangles[gaussian, 3]):
                block_y = line + (np.float32(tile_y * TILE) + _HALF - mean_y)
                for tile_x in range(rectangles[gaussian, 0], rectangles[gaussian, 1]):
                    block_x = column + (np.float32(tile_x * TILE) + _HALF - mean_x)
                    mask = _touched_blocks(block_x, block_y, first, mixed, second, slope_x, slope_y, limit)
                    tiles[slot] = tile_y * tiles_x + tile_x
                    masks[slot] = mask
                    slot += mask != 0
            ranges[gaussian, 1] = slot


@serial_kernel
def sort_by_depth(depths, visible, visible_counts, ids, keys, other_ids, other_keys, histogram):
    """Writes the visible ids into ``ids`` in order of depth, equal depths in order of index.

    A radix sort in three passes of eleven bits; the bit pattern of a positive float grows with the float.
    """
    count = 0
    for chunk in range(visible_counts.shape[0]):
        for position in range(chunk * CHUNK, chunk * CHUNK + visible_counts[chunk]):
            other_ids[count] = visible[position]
            other_keys[count] = depths[visible[position]]
            count += 1
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
    return count


@kernel
def deal_to_tiles(ids, count, ranges, tiles, masks, counts, tile_starts, instances):
    """Deals the instances out to the tiles, front to back.

    Args:
        ids: [count] visible Gaussians in order of depth.
        ranges, tiles, masks: what ``find_instances`` found.
        counts: scratch [workers, tiles].
        tile_starts: out [tiles + 1].
        instances: out [instances, INSTANCE], tile by tile.
    """
    workers, tile_count = counts.shape
    share = (count + workers - 1) // workers
    for worker in prange(workers):
        for tile in range(tile_count):
            counts[worker, tile] = 0
        for k in range(worker * share, min(count, (worker + 1) * share)):
            for slot in range(ranges[ids[k], 0], ranges[ids[k], 1]):
                counts[worker, tiles[slot]] += 1
    running = np.int64(0)
    for tile in range(tile_count):
        tile_starts[tile] = running
        for worker in range(workers):
            running += counts[worker, tile]
            counts[worker, tile] = running - counts[worker, tile]
    tile_starts[tile_count] = running
    for worker in prange(workers):
        for k in range(worker * share, min(count, (worker + 1) * share)):
            for slot in range(ranges[ids[k], 0], ranges[ids[k], 1]):
                place = counts[worker, tiles[slot]]
                counts[worker, tiles[slot]] = place + 1
                instances[place, 0] = ids[k]
                instances[place, 1] = slot
                instances[place, 2] = masks[slot]
