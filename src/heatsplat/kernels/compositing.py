"""Front-to-back compositing of the instances of a tile, and its gradient; a vector is a block of 4x4 pixels.

Plain twin: heatsplat.renderers.reference.

Pixel state lives in blocks: entry (tile, block) of a state array is one vector per modality or channel. A pixel that is
finished keeps its transmittance with the sign flipped: the next transmittance is then negative as well, so the one
comparison with TRANSMITTANCE_MIN turns away finished pixels and those about to finish.

The backward pass walks front to back as the forward pass does, with what remains of the loss behind each Gaussian,

    R = sum over later j of w_j (v . f_j) + T_final v_T,   dL/d(log alpha_i) = w_i (v . f_i) - R_i alpha_i / (1 - alpha_i),

so it needs neither per-pixel lists nor divisions of transmittances. The density is exp2(-|u|^2) of whitened offsets u, so
the gradient of everything geometric is a linear function of five moments of g = dL/d(log alpha): the sums of g u1, g u2,
g u1^2, g u1 u2 and g u2^2 over pixels. They stay in registers over the blocks of an instance and are added up across lanes
once per instance, into a slot of its own.
"""

from __future__ import annotations

import numpy as np
from numba import prange

from heatsplat.kernels.compilation import inline, kernel, part
from heatsplat.kernels.layout import (
    channels,
    has_absgrad,
    has_depth,
    modalities,
    modality_of,
    moment_count,
)
from heatsplat.kernels.projection import DEPTH_MOMENT, GEOMETRY, LOG2_ALPHA_MIN, OPACITY_MOMENTS, TILE
from heatsplat.kernels.scheduling import take
from heatsplat.kernels.simd import (
    LANES,
    absolute,
    bits,
    exp2,
    load,
    lowest_bit,
    minimum,
    prefetch,
    registers,
    select,
    splat,
    store,
    store_first,
    store_scalar,
    total,
    totals,
)

ALPHA_MIN = np.float32(1.0 / 255.0)
ALPHA_MAX = np.float32(0.999)
TRANSMITTANCE_MIN = np.float32(1e-4)
BLOCKS = 16
BATCH = 32  # instances between two looks at which blocks are finished
AHEAD = 8  # instances ahead of use that records are fetched

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@inline
def _offset(records, record, tile_x, tile_y):
    """u1 and u2 of the corner of a tile: what is left of the whitening once it is linear in the pixels of the tile."""
    x, y = tile_x - records[record, 0], tile_y - records[record, 1]
    return records[record, 2] * x + records[record, 3] * y, records[record, 4] * y


@inline
def _whitened(records, record, offset, pixels, block):
    """u1 and u2 of the pixels of a block."""
    x, y = load(pixels, block * LANES), load(pixels, (BLOCKS + block) * LANES)
    return (
        records[record, 2] * x + (records[record, 3] * y + offset[0]),
        records[record, 4] * y + offset[1],
    )


@inline
def _alpha(layout, modality, density, reached, records, record):
    """Alpha of a modality before it is clamped, and where it is not skipped."""
    if modalities(layout) == 1:
        return density, reached
    alpha = density * records[record, GEOMETRY + modality]
    return alpha, reached & (alpha >= ALPHA_MIN)


@inline
def _unfinished_blocks(layout, tile, transmittances):
    """A bit mask of the blocks of a tile with a pixel that still takes light."""
    blocks = 0
    for block in range(BLOCKS):
        for modality in range(modalities(layout)):
            place = ((tile * BLOCKS + block) * modalities(layout) + modality) * LANES
            blocks |= (bits(load(transmittances, place) > _ZERO) != 0) << block
    return blocks


@part
def _composite_tile(layout, tile, tiles_x, records, instances, begin, end, pixels, transmittances, image):
    """Composites instances ``begin`` to ``end`` into the state of a tile; returns the end of those that mattered.

    Block masks are reduced to the blocks where a pixel took something, which is what the backward pass has to visit.
    """
    tile_x, tile_y = np.float32(tile % tiles_x * TILE), np.float32(tile // tiles_x * TILE)
    for block in range(tile * BLOCKS, (tile + 1) * BLOCKS):
        for modality in range(modalities(layout)):
            store(transmittances, (block * modalities(layout) + modality) * LANES, splat(_ONE))
        for channel in range(channels(layout)):
            store(image, (block * channels(layout) + channel) * LANES, splat(_ZERO))
    weights = registers(modalities(layout))
    features = GEOMETRY + (modalities(layout) if modalities(layout) > 1 else 0)
    last = begin
    for batch in range(begin, end, BATCH):
        unfinished = _unfinished_blocks(layout, tile, transmittances)
        if unfinished == 0:
            break
        for instance in range(batch, min(batch + BATCH, end)):
            prefetch(records, np.int64(instances[min(instance + AHEAD, end - 1), 0]) * records.shape[1])
            record = np.int64(instances[instance, 0])
            blocks = np.int64(instances[instance, 2]) & unfinished
            offset = _offset(records, record, tile_x, tile_y)
            used = 0
            while blocks != 0:
                block = lowest_bit(blocks)
                blocks &= blocks - 1
                state = tile * BLOCKS + block
                u1, u2 = _whitened(records, record, offset, pixels, block)
                exponent = records[record, 5] - u1 * u1 - u2 * u2
                reached = exponent >= LOG2_ALPHA_MIN
                density = exp2(exponent)
                anything = 0
                for modality in range(modalities(layout)):
                    alpha, passed = _alpha(layout, modality, density, reached, records, record)
                    alpha = select(passed, minimum(alpha, ALPHA_MAX), _ZERO)
                    place = (state * modalities(layout) + modality) * LANES
                    before = load(transmittances, place)
                    after = before - alpha * before
                    taken = after > TRANSMITTANCE_MIN
                    weights[modality] = select(taken, alpha * before, _ZERO)
                    anything |= bits(taken & passed)
                    store(transmittances, place, select(taken, after, -absolute(before)))
                for channel in range(channels(layout)):
                    place = (state * channels(layout) + channel) * LANES
                    colour = weights[modality_of(layout, channel)] * records[record, features + channel]
                    store(image, place, load(image, place) + colour)
                used |= (anything != 0) << block
            instances[instance, 2] = used
            if used != 0:
                last = instance + 1
    return last


@part
def _write_tile(layout, tile, tiles_x, width, height, transmittances, image, background, features, alpha, depth):
    """Copies the state of a tile into the images, background added, pixel by pixel."""
    left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
    colours = features.shape[2]
    for y in range(top, min(top + TILE, height)):
        for x in range(left, min(left + TILE, width)):
            block = tile * BLOCKS + (y - top) // 4 * 4 + (x - left) // 4
            lane = (y - top) % 4 * 4 + (x - left) % 4
            for modality in range(modalities(layout)):
                transmittances[block, modality, lane] = abs(transmittances[block, modality, lane])
                alpha[modality, y, x] = _ONE - transmittances[block, modality, lane]
            for channel in range(channels(layout)):
                if channel < colours:
                    behind = transmittances[block, modality_of(layout, channel), lane]
                    image[block, channel, lane] += behind * background[channel]
                    features[y, x, channel] = image[block, channel, lane]
                else:
                    depth[y, x] = image[block, channel, lane]


@kernel
def composite(
    layout, workers, width, height, records, instances, tile_starts, background, pixels, ticket,
    tile_ends, transmittances, image, features, alpha, depth,
):  # fmt: skip
    """Composites all tiles.

    Args:
        workers: how many threads share the tiles, each taking the next one when it is done.
        ticket: [1] int64, zero.
        tile_ends: out [tiles], the end of the instances that mattered to a tile.
        transmittances, image: out, state by blocks: what is left of the light, and the channels with their background.
        features, alpha, depth: out [H, W, C], [M, H, W], [H, W] (the last only where the layout has a channel for it).
    """
    tiles_x = (width + TILE - 1) // TILE
    tiles = tile_ends.shape[0]
    for _ in prange(workers):
        tile = take(ticket, 1)
        while tile < tiles:
            tile_ends[tile] = _composite_tile(
                layout,
                tile,
                tiles_x,
                records,
                instances,
                tile_starts[tile],
                tile_starts[tile + 1],
                pixels,
                transmittances,
                image,
            )
            _write_tile(layout, tile, tiles_x, width, height, transmittances, image, background, features, alpha, depth)
            tile = take(ticket, 1)


@part
def _read_gradients(layout, tile, tiles_x, width, height, v_features, v_alpha, v_depth, v_pixels, worker):
    """Copies the gradients of a tile's pixels into block order; pixels outside the image get zero."""
    left, top = tile % tiles_x * TILE, tile // tiles_x * TILE
    colours = v_features.shape[2]
    for y in range(TILE):
        for x in range(TILE):
            block = worker * BLOCKS + y // 4 * 4 + x // 4
            lane = y % 4 * 4 + x % 4
            inside = (top + y < height) & (left + x < width)
            for channel in range(channels(layout)):
                value = _ZERO
                if inside:
                    if channel < colours:
                        value = v_features[top + y, left + x, channel]
                    else:
                        value = v_depth[top + y, left + x]
                v_pixels[block, channel, lane] = value
            for modality in range(modalities(layout)):
                value = _ZERO
                if inside:
                    value = v_alpha[modality, top + y, left + x]
                v_pixels[block, channels(layout) + modality, lane] = value


@part
def _start_remainders(layout, tile, colours, transmittances, image, v_pixels, worker, state, v_background):
    """Fills a worker's state with transmittance one and the whole of v . image - v_alpha T_final."""
    size = channels(layout) + modalities(layout)
    for block in range(BLOCKS):
        pixels = (worker * BLOCKS + block) * size
        final = (tile * BLOCKS + block) * modalities(layout)
        for modality in range(modalities(layout)):
            rest = -load(v_pixels, (pixels + channels(layout) + modality) * LANES)
            rest = rest * load(transmittances, (final + modality) * LANES)
            for channel in range(channels(layout)):
                if modality_of(layout, channel) == modality:
                    composited = load(image, ((tile * BLOCKS + block) * channels(layout) + channel) * LANES)
                    rest = rest + composited * load(v_pixels, (pixels + channel) * LANES)
            place = ((worker * BLOCKS + block) * modalities(layout) + modality) * 2 * LANES
            store(state, place, splat(_ONE))
            store(state, place + LANES, rest)
        for channel in range(colours):
            behind = load(transmittances, (final + modality_of(layout, channel)) * LANES)
            v_background[tile, channel] += total(behind * load(v_pixels, (pixels + channel) * LANES))


@part
def _store_moments(layout, moments, slots, place):
    """Writes the sums over lanes of the moments from ``place`` on, up to the end of the slot."""
    if moment_count(layout) <= LANES:
        store_first(slots, place, totals(moments), slots.shape[1])
    else:
        for k in range(moment_count(layout)):
            store_scalar(slots, place + k, total(moments[k]))


@part
def _store_zeros(layout, slots, place):
    for k in range(0, moment_count(layout), LANES):
        store_first(slots, place + k, splat(_ZERO), slots.shape[1] - k)


@part
def _composite_tile_backward(
    layout, tile, tiles_x, records, instances, begin, end, pixels, v_pixels, worker, state, slots
):
    """Leaves the moments of instances ``begin`` to ``end`` of a tile in their gradient slots."""
    tile_x, tile_y = np.float32(tile % tiles_x * TILE), np.float32(tile // tiles_x * TILE)
    size = channels(layout) + modalities(layout)
    features = GEOMETRY + (modalities(layout) if modalities(layout) > 1 else 0)
    moments = registers(moment_count(layout))
    weights = registers(modalities(layout))
    along = registers(modalities(layout))
    for instance in range(begin, end):
        prefetch(records, np.int64(instances[min(instance + AHEAD, end - 1), 0]) * records.shape[1])
        blocks = np.int64(instances[instance, 2])
        slot = np.int64(instances[instance, 1]) * slots.shape[1]
        if blocks == 0:
            _store_zeros(layout, slots, slot)
            continue
        record = np.int64(instances[instance, 0])
        offset = _offset(records, record, tile_x, tile_y)
        for k in range(moment_count(layout)):
            moments[k] = splat(_ZERO)
        while blocks != 0:
            block = lowest_bit(blocks)
            blocks &= blocks - 1
            v_block = (worker * BLOCKS + block) * size
            u1, u2 = _whitened(records, record, offset, pixels, block)
            exponent = records[record, 5] - u1 * u1 - u2 * u2
            reached = exponent >= LOG2_ALPHA_MIN
            density = exp2(exponent)
            for modality in range(modalities(layout)):
                along[modality] = splat(_ZERO)
            for channel in range(channels(layout)):
                modality = modality_of(layout, channel)
                v_pixel = load(v_pixels, (v_block + channel) * LANES)
                along[modality] = along[modality] + v_pixel * records[record, features + channel]
            gradient = splat(_ZERO)
            for modality in range(modalities(layout)):
                alpha, passed = _alpha(layout, modality, density, reached, records, record)
                free = passed & (alpha < ALPHA_MAX)
                alpha = select(passed, minimum(alpha, ALPHA_MAX), _ZERO)
                place = ((worker * BLOCKS + block) * modalities(layout) + modality) * 2 * LANES
                before, rest = load(state, place), load(state, place + LANES)
                after = before - alpha * before
                taken = after > TRANSMITTANCE_MIN
                weight = select(taken, alpha * before, _ZERO)
                weights[modality] = weight
                store(state, place, select(taken, after, -absolute(before)))
                gain = weight * along[modality]
                rest = rest - gain
                store(state, place + LANES, rest)
                v_log_alpha = select(free & taken, gain - rest * (alpha / (_ONE - alpha)), _ZERO)
                k = OPACITY_MOMENTS + modality
                moments[k] = moments[k] + v_log_alpha
                gradient = gradient + v_log_alpha
                if has_absgrad(layout):
                    g1, g2 = v_log_alpha * u1, v_log_alpha * u2
                    k = moment_count(layout) - 2
                    moments[k] = moments[k] + absolute(g1 * records[record, 2])
                    moments[k + 1] = moments[k + 1] + absolute(g1 * records[record, 3] + g2 * records[record, 4])
            g1, g2 = gradient * u1, gradient * u2
            moments[0] = moments[0] + g1
            moments[1] = moments[1] + g2
            moments[2] = moments[2] + g1 * u1
            moments[3] = moments[3] + g1 * u2
            moments[4] = moments[4] + g2 * u2
            for channel in range(channels(layout)):
                is_depth = has_depth(layout) and channel == channels(layout) - 1
                k = DEPTH_MOMENT if is_depth else OPACITY_MOMENTS + modalities(layout) + channel
                v_pixel = load(v_pixels, (v_block + channel) * LANES)
                moments[k] = moments[k] + weights[modality_of(layout, channel)] * v_pixel
        _store_moments(layout, moments, slots, slot)


@kernel
def composite_backward(
    layout, workers, width, height, records, instances, tile_starts, tile_ends, transmittances, image, pixels, ticket,
    v_features, v_alpha, v_depth, v_pixels, state, slots, v_backgrounds,
):  # fmt: skip
    """Leaves the moments of every instance in its gradient slot, and the background's gradient tile by tile.

    Args:
        v_features, v_alpha, v_depth: gradients of the images, as in ``composite``.
        v_pixels: scratch, flat: (channels + modalities) vectors per worker and block.
        state: scratch, flat: transmittance and remainder per worker, block and modality.
        slots: out, flat, ``slot_size(layout)`` numbers per instance.
        v_backgrounds: out [tiles, C].
    """
    tiles_x = (width + TILE - 1) // TILE
    tiles = tile_ends.shape[0]
    for worker in prange(workers):
        tile = take(ticket, 1)
        while tile < tiles:
            for channel in range(v_features.shape[2]):
                v_backgrounds[tile, channel] = _ZERO
            _read_gradients(layout, tile, tiles_x, width, height, v_features, v_alpha, v_depth, v_pixels, worker)
            _start_remainders(
                layout, tile, v_features.shape[2], transmittances, image, v_pixels, worker, state, v_backgrounds
            )
            _composite_tile_backward(
                layout,
                tile,
                tiles_x,
                records,
                instances,
                tile_starts[tile],
                tile_ends[tile],
                pixels,
                v_pixels,
                worker,
                state,
                slots,
            )
            for instance in range(tile_ends[tile], tile_starts[tile + 1]):
                _store_zeros(layout, slots, np.int64(instances[instance, 1]) * slots.shape[1])
            tile = take(ticket, 1)
