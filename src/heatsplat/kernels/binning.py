"""Which Gaussians touch which 4x4 pixel blocks of which tile, front to back.

Plain twin: an argsort of depths and a comparison of every pixel with every Gaussian (tests/kernels/test_binning.py).

An instance is one Gaussian on one tile with the mask of the blocks that it reaches there: bit 8 * row + column of an
int64. Depths are sorted once per Gaussian, not once per instance; instances are then found front to back and dealt
out to their tiles in that order, so no tile ever sorts. Threads work on slabs of Gaussians along the depth; the
result is the one order there is, whatever the slabs.
"""

from __future__ import annotations

import numpy as np

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.constants import (
    BLOCK,
    CHUNK,
    DEPTH,
    ELLIPSE,
    INVERSE_FIRST,
    LIMIT,
    MEAN_X,
    MEAN_Y,
    PEAK,
    RANK,
    SCREEN,
    SECOND,
    SLOPE,
    TILE,
    TILE_BLOCKS,
)
from heatsplat.kernels.projection import box, box_tiles
from heatsplat.kernels.scheduling import parallel_for, take
from heatsplat.kernels.simd import (
    bytes_of,
    ceil,
    floor,
    lane_indices,
    load,
    maximum,
    minimum,
    prefetch,
    select,
    splat,
    sqrt,
    store_first,
    to_float,
    to_int,
)

RADIX_BITS = 11
BUCKETS = 1 << RADIX_BITS
SLABS = 64  # per thread, since near slabs hold more instances than far ones
AHEAD = 16  # Gaussians ahead of their use that rows are fetched
MARGIN = 0.02  # pixels, more than the rounding of an interval's ends: a mask may hold too much, never too little


@kernel
def sort_by_depth(visible, depths, ids, keys, other_ids, other_keys, histogram):
    """Writes the ids ``visible`` [n] into ``ids`` in order of depth, equal depths in order of index.

    A radix sort in three passes of eleven bits; the bit pattern of a positive float grows with the float.

    Args:
        depths: [N] positive.
        keys, other_ids, other_keys, histogram: scratch [n], [n], [n], [BUCKETS].
    """
    for k in range(visible.shape[0]):
        other_ids[k] = visible[k]
        other_keys[k] = depths[visible[k]]
    patterns, other_patterns = keys.view(np.uint32), other_keys.view(np.uint32)
    for radix_pass in range(3):
        shift = np.uint32(RADIX_BITS * radix_pass)
        for bucket in range(BUCKETS):
            histogram[bucket] = 0
        for k in range(visible.shape[0]):
            histogram[(other_patterns[k] >> shift) & np.uint32(BUCKETS - 1)] += 1
        running = np.int64(0)
        for bucket in range(BUCKETS):
            running += histogram[bucket]
            histogram[bucket] = running - histogram[bucket]
        for k in range(visible.shape[0]):
            bucket = (other_patterns[k] >> shift) & np.uint32(BUCKETS - 1)
            place = histogram[bucket]
            histogram[bucket] = place + 1
            patterns[place] = other_patterns[k]
            ids[place] = other_ids[k]
        ids, other_ids = other_ids, ids
        patterns, other_patterns = other_patterns, patterns


@inline
def feature_row(gaussian, screen, rows_are_ranks, first_ranks):
    """The row of a Gaussian in features that are given for all Gaussians, or for the visible ones only."""
    return first_ranks[gaussian // CHUNK] + np.int64(screen[gaussian, RANK]) if rows_are_ranks else gaussian


@inline
def _pack(rank, gaussian, screen, features, row, opacities, with_depth, records):
    """Writes the record of a Gaussian, what compositing reads of it: see ``layout.Layout``."""
    store_first(records, rank * records.shape[1], load(screen, gaussian * SCREEN), ELLIPSE)
    column = ELLIPSE
    modalities, colours = opacities.shape[0], features.shape[1]
    if modalities > 1:
        largest = opacities[0, gaussian]
        for modality in range(1, modalities):
            largest = max(largest, opacities[modality, gaussian])
        for modality in range(modalities):
            records[rank, column + modality] = opacities[modality, gaussian] / largest
        column += modalities
    for channel in range(colours):
        records[rank, column + channel] = features[row, channel]
    if with_depth:
        records[rank, column + colours] = screen[gaussian, DEPTH]


@inline
def _spans(gaussian, screen, first_row):
    """First column, and column after the last, of the blocks that a Gaussian reaches in each of sixteen rows of blocks.

    It reaches the blocks that hold a point with u1^2 + u2^2 <= LIMIT. A row of blocks is a band of y, which cuts an
    interval of x out of this ellipse: its right end lies at the y of the ellipse's rightmost point (PEAK), or as near
    to it as the band allows, and its left end likewise at -PEAK.
    """
    left, right, top, bottom = box(gaussian, screen)
    mean_x, second, limit = screen[gaussian, MEAN_X], screen[gaussian, SECOND], screen[gaussian, LIMIT]
    slope, inverse, peak = screen[gaussian, SLOPE], screen[gaussian, INVERSE_FIRST], screen[gaussian, PEAK]
    rows = lane_indices() + np.int32(first_row)
    low = to_float(rows * BLOCK) + 0.5 - screen[gaussian, MEAN_Y]
    high = low + (BLOCK - 1)
    y_right, y_left = maximum(minimum(high, peak), low), maximum(minimum(high, -peak), low)
    square_right = limit - second * second * y_right * y_right
    square_left = limit - second * second * y_left * y_left
    x_right = slope * y_right + sqrt(square_right) * inverse + mean_x
    x_left = slope * y_left - sqrt(square_left) * inverse + mean_x
    begin = maximum(ceil((x_left - MARGIN - BLOCK + 0.5) * (1 / BLOCK)), left)
    end = minimum(floor((x_right + MARGIN - 0.5) * (1 / BLOCK)) + 1.0, right)
    crossed = (rows >= top) & (rows < bottom) & (square_right >= 0.0) & (square_left >= 0.0)
    return begin, select(crossed, maximum(end, begin), begin)


@inline
def _find(gaussian, screen, tiles_x, found, place, counts, slab):
    """Writes tile and mask of the instances of a Gaussian from ``place`` of ``found`` on; returns the place after."""
    left, right, top, bottom = box(gaussian, screen)
    for tile_y in range(top // TILE_BLOCKS, (bottom + TILE_BLOCKS - 1) // TILE_BLOCKS, 2):
        begin, end = _spans(gaussian, screen, tile_y * TILE_BLOCKS)
        for tile_x in range(left // TILE_BLOCKS, (right + TILE_BLOCKS - 1) // TILE_BLOCKS):
            # The bits from one column to another in a byte per row, for this tile and the one below.
            first = to_int(minimum(maximum(begin - tile_x * TILE_BLOCKS, 0.0), TILE_BLOCKS))
            last = to_int(minimum(maximum(end - tile_x * TILE_BLOCKS, 0.0), TILE_BLOCKS))
            one = splat(np.int32(1))
            tile = tile_y * tiles_x + tile_x
            for mask in bytes_of((one << last) - (one << first)):
                # No branch: whether the lower mask is empty is hard to predict (measured: 8 ns per Gaussian).
                found[place, 0] = tile
                found[place, 1] = mask
                touched = np.int64(mask != 0)
                place += touched
                counts[slab, tile] += touched
                tile += tiles_x
    return place


@inline
def _find_slabs(
    _worker, ids, screen, width, features, rows_are_ranks, first_ranks, opacities, with_depth, tickets,
    records, found, found_starts, found_counts, counts,
):  # fmt: skip
    """``find_instances`` in slabs, as long as there are any."""
    slabs = counts.shape[0]
    tiles_x = (width + TILE - 1) // TILE
    count = ids.shape[0]
    share = (count + slabs - 1) // slabs
    slab = take(tickets[0], 1)
    while slab < slabs:
        for tile in range(counts.shape[1]):
            counts[slab, tile] = 0
        room = np.int64(1)
        for rank in range(slab * share, min(count, (slab + 1) * share)):
            prefetch(screen, np.int64(ids[min(rank + AHEAD, count - 1)]) * SCREEN)
            gaussian = np.int64(ids[rank])
            prefetch(features, feature_row(gaussian, screen, rows_are_ranks, first_ranks) * features.shape[1])
            room += box_tiles(gaussian, screen)
        place = take(tickets[1], room)
        found_starts[slab] = place
        for rank in range(slab * share, min(count, (slab + 1) * share)):
            gaussian = np.int64(ids[rank])
            row = feature_row(gaussian, screen, rows_are_ranks, first_ranks)
            _pack(rank, gaussian, screen, features, row, opacities, with_depth, records)
            before = place
            place = _find(gaussian, screen, tiles_x, found, place, counts, slab)
            found_counts[rank] = place - before
        slab = take(tickets[0], 1)


@kernel
def find_instances(
    workers, ids, screen, width, features, rows_are_ranks, first_ranks, opacities, with_depth, tickets,
    records, found, found_starts, found_counts, counts,
):  # fmt: skip
    """Packs the records of the visible Gaussians and finds the blocks that these reach.

    Args:
        workers: how many threads share the slabs.
        ids: [n] visible Gaussians front to back.
        screen, first_ranks: see ``projection.project``.
        features: [N, C], or [n, C] of the visible ones by ascending id where ``rows_are_ranks``.
        tickets: [2, 1] int64, zero.
        records: out [n, record_size], front to back.
        found: out, tile and mask of each instance; each slab's own lie side by side, front to back, and one to spare.
        found_starts: out [slabs], where those of a slab begin.
        found_counts: out [n], how many instances a Gaussian has.
        counts: out [slabs, tiles and a row of tiles to spare], how many instances of a slab a tile has.
    """
    parallel_for(
        _find_slabs, workers,
        (ids, screen, width, features, rows_are_ranks, first_ranks, opacities, with_depth, tickets,
         records, found, found_starts, found_counts, counts),
    )  # fmt: skip


@inline
def _deal_slabs(
    _worker, share, ids, found, found_starts, found_counts, counts, ticket, slab_starts, spans, instances
):  # fmt: skip
    """``deal_to_tiles`` in slabs, as long as there are any."""
    slabs, count = counts.shape[0], found_counts.shape[0]
    slab = take(ticket, 1)
    while slab < slabs:
        slot, source = slab_starts[slab], found_starts[slab]
        for rank in range(slab * share, min(count, (slab + 1) * share)):
            gaussian = np.int64(ids[rank])
            spans[gaussian, 0] = slot
            for _instance in range(found_counts[rank]):
                tile = found[source, 0]
                place = counts[slab, tile]
                counts[slab, tile] = place + 1
                instances[place, 0] = rank | slot << 32
                instances[place, 1] = found[source, 1]
                slot += 1
                source += 1
            spans[gaussian, 1] = slot
        slab = take(ticket, 1)


@kernel
def deal_to_tiles(
    workers, ids, found, found_starts, found_counts, counts, ticket, slab_starts, spans, tile_starts, instances
):  # fmt: skip
    """Deals the instances out to the tiles, front to back, and numbers their gradient slots.

    Args:
        ids, found, found_starts, found_counts, counts: what ``find_instances`` took and found; ``counts`` is overwritten.
        ticket, slab_starts: [1] int64, zero, and scratch [slabs].
        spans: out [N, 2] int32, the first gradient slot of a visible Gaussian and the one after its last.
        tile_starts: out [tiles + 1], the first instance of a tile.
        instances: out [instances, 2] int64, tile by tile: rank of the Gaussian and slot (32 bits each), block mask.
    """
    slabs, tiles = counts.shape[0], tile_starts.shape[0] - 1
    count = found_counts.shape[0]
    share = (count + slabs - 1) // slabs
    for slab in range(slabs):
        slab_starts[slab] = 0
    running = np.int64(0)
    for tile in range(tiles):
        tile_starts[tile] = running
        for slab in range(slabs):
            here = counts[slab, tile]
            counts[slab, tile] = running
            slab_starts[slab] += here
            running += here
    tile_starts[tiles] = running
    running = np.int64(0)
    for slab in range(slabs):
        running += slab_starts[slab]
        slab_starts[slab] = running - slab_starts[slab]
    parallel_for(
        _deal_slabs, workers,
        (share, ids, found, found_starts, found_counts, counts, ticket, slab_starts, spans, instances),
    )  # fmt: skip
