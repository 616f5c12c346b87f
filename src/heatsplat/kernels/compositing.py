"""Front-to-back compositing of the instances of a tile, and its gradient; a vector is a block of 4x4 pixels.

Plain twin: heatsplat.renderers.reference, under autograd.

A pixel takes a Gaussian's colour with weight alpha T, where T is the transmittance left by those in front, and is
finished before T would fall to TRANSMITTANCE_MIN. The transmittance of a finished pixel is kept with its sign
flipped: whatever comes next, T (1 - alpha) is negative too, so one comparison turns away finished pixels and those
about to finish.

The backward pass walks front to back as the forward pass did, with what remains of the loss behind each Gaussian,

    R_i = sum over j > i of w_j (v . f_j) + T_final v_T,
    dL / d log(alpha_i) = w_i (v . f_i) - R_i alpha_i / (1 - alpha_i),

where f are features and v the gradients of a pixel, so it needs neither lists per pixel nor divisions of
transmittances. With g = dL / d log(alpha) and a density exp2(-u1^2 - u2^2), the gradient of everything geometric is
linear in five moments: the sums over pixels of g u1, g u2, g u1^2, g u1 u2 and g u2^2. They stay in registers over
the blocks of an instance and are added up across lanes once, into the instance's own slot; so no two threads ever add
to the same number.
"""

from __future__ import annotations

import numpy as np

from heatsplat.kernels.buffers import aligned
from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    BLOCK,
    BLOCKS,
    ELLIPSE,
    FIRST,
    LOG2_ALPHA_MIN,
    LOG_OPACITY,
    MEAN_X,
    MEAN_Y,
    MIXED,
    OPACITY_GRADIENTS,
    SECOND,
    TILE,
    TILE_BLOCKS,
    TRANSMITTANCE_MIN,
)
from heatsplat.kernels.layout import (
    channels,
    feature_column,
    has_absgrad,
    map_count,
    modalities,
    modality_of,
    pixel_rows,
    slot_columns,
)
from heatsplat.kernels.scheduling import parallel_for, take
from heatsplat.kernels.simd import (
    LANES,
    absolute,
    bits,
    exp2,
    load_scalar,
    load_vector,
    lowest_bit,
    minimum,
    prefetch,
    registers,
    select,
    splat,
    store_first,
    store_scalar,
    store_vector,
    total,
    totals,
)

BATCH = 64  # instances between two looks at which blocks are finished
AHEAD = 8  # instances ahead of their use that records are fetched


def pixel_centres() -> np.ndarray:
    """x of the pixels of each column of blocks and y of those of each row, from the corner of a tile, [2, 8, LANES]."""
    lanes, blocks = np.arange(LANES), BLOCK * np.arange(TILE_BLOCKS)[:, None]
    centres = aligned(np.float32, 2, TILE_BLOCKS, LANES)
    centres[:] = blocks + lanes % BLOCK + 0.5, blocks + lanes // BLOCK + 0.5
    return centres


@inline
def _corner(records, rank, tile, tiles_x):
    """u1 and u2 at the corner of a tile."""
    x = np.float32(tile % tiles_x * TILE) - records[rank, MEAN_X]
    y = np.float32(tile // tiles_x * TILE) - records[rank, MEAN_Y]
    return records[rank, FIRST] * x + records[rank, MIXED] * y, records[rank, SECOND] * y


@inline
def _whitened(records, rank, corner, centres, block):
    """u1 and u2 at the pixels of a block."""
    x = load_vector(centres, block % TILE_BLOCKS)
    y = load_vector(centres, TILE_BLOCKS + block // TILE_BLOCKS)
    return (
        records[rank, FIRST] * x + (records[rank, MIXED] * y + corner[0]),
        records[rank, SECOND] * y + corner[1],
    )


@inline
def _density(records, rank, u1, u2):
    """Density times the largest opacity, and where it is not skipped."""
    exponent = records[rank, LOG_OPACITY] - u1 * u1 - u2 * u2
    return exp2(exponent), exponent >= LOG2_ALPHA_MIN


@inline
def _alpha(layout, modality, records, rank, density, passed):
    """Alpha of a modality before it is clamped, and where it is not skipped."""
    if modalities(layout) > 1:
        density = density * records[rank, ELLIPSE + modality]
        passed = passed & (density >= ALPHA_MIN)
    return density, passed


@inline
def _take(alpha, passed, before):
    """What an alpha does to pixels of a transmittance: alpha as it counts, weight, transmittance after, who took it."""
    alpha = select(passed, minimum(alpha, ALPHA_MAX), 0.0)
    weight = alpha * before
    after = before - weight
    taken = after > TRANSMITTANCE_MIN
    return alpha, select(taken, weight, 0.0), select(taken, after, -absolute(before)), taken


@inline
def _unfinished(layout, tile, transmittances):
    """A bit mask of the blocks of a tile that have a pixel which is not finished."""
    mask = 0
    for block in range(BLOCKS):
        for modality in range(modalities(layout)):
            left = load_vector(transmittances, (tile * BLOCKS + block) * modalities(layout) + modality)
            mask |= np.int64(bits(left > 0.0) != 0) << block
    return mask


@inline
def _composite_tile(layout, tile, tiles_x, records, instances, begin, end, centres, transmittances, image):
    """Composites instances ``begin`` to ``end`` into the state of a tile; returns the end of those that mattered.

    Masks are reduced to the blocks where a pixel took something or was finished by what it could not take, which are those
    that the backward pass visits.
    """
    for block in range(tile * BLOCKS, (tile + 1) * BLOCKS):
        for modality in range(modalities(layout)):
            store_vector(transmittances, block * modalities(layout) + modality, splat(1.0))
        for channel in range(channels(layout)):
            store_vector(image, block * channels(layout) + channel, splat(0.0))
    weights = registers(modalities(layout))
    last = begin
    for batch in range(begin, end, BATCH):
        unfinished = _unfinished(layout, tile, transmittances)
        if unfinished == 0:
            break
        for instance in range(batch, min(batch + BATCH, end)):
            prefetch(records, (instances[min(instance + AHEAD, end - 1), 0] & 0xFFFFFFFF) * records.shape[1])
            rank = instances[instance, 0] & 0xFFFFFFFF
            blocks = instances[instance, 1] & unfinished
            corner = _corner(records, rank, tile, tiles_x)
            useful = 0
            while blocks != 0:
                block = lowest_bit(blocks)
                blocks &= blocks - 1
                state = tile * BLOCKS + block
                u1, u2 = _whitened(records, rank, corner, centres, block)
                density, reached = _density(records, rank, u1, u2)
                counts = 0
                for modality in range(modalities(layout)):
                    alpha, passed = _alpha(layout, modality, records, rank, density, reached)
                    place = state * modalities(layout) + modality
                    before = load_vector(transmittances, place)
                    _, weight, after, _ = _take(alpha, passed, before)
                    store_vector(transmittances, place, after)
                    weights[modality] = weight
                    counts |= bits(passed & (before > 0.0))
                for channel in range(channels(layout)):
                    place = state * channels(layout) + channel
                    colour = weights[modality_of(layout, channel)] * records[rank, feature_column(layout) + channel]
                    store_vector(image, place, load_vector(image, place) + colour)
                useful |= np.int64(counts != 0) << block
            instances[instance, 1] = useful
            if useful != 0:
                last = instance + 1
    return last


@inline
def _write_block(source, place, target, offset, step, row, wide, high):
    """Copies a vector to the pixels of a block: ``step`` numbers from one to the next, ``row`` from one row to the next."""
    for y in range(high):
        for x in range(wide):
            store_scalar(target, offset + y * row + x * step, load_scalar(source, place + y * BLOCK + x))


@inline
def _write_tile(layout, tile, tiles_x, transmittances, image, background, features, alpha, depth):
    """Copies the state of a tile into the images, with the background behind it."""
    height, width, colours = features.shape
    for block in range(BLOCKS):
        left = tile % tiles_x * TILE + block % TILE_BLOCKS * BLOCK
        top = tile // tiles_x * TILE + block // TILE_BLOCKS * BLOCK
        wide, high = min(BLOCK, width - left), min(BLOCK, height - top)
        if wide <= 0 or high <= 0:
            continue
        here, pixel = tile * BLOCKS + block, top * width + left
        for modality in range(modalities(layout)):
            place = here * modalities(layout) + modality
            behind = absolute(load_vector(transmittances, place))
            store_vector(transmittances, place, np.float32(1.0) - behind)
            _write_block(transmittances, place * LANES, alpha, modality * height * width + pixel, 1, width, wide, high)
            store_vector(transmittances, place, behind)
        for channel in range(colours):
            place = here * channels(layout) + channel
            behind = load_vector(transmittances, here * modalities(layout) + modality_of(layout, channel))
            store_vector(image, place, load_vector(image, place) + behind * background[channel])
            offset, row = pixel * colours + channel, width * colours
            _write_block(image, place * LANES, features, offset, colours, row, wide, high)
        if depth.shape[0] > 0:
            _write_block(image, (here * channels(layout) + colours) * LANES, depth, pixel, 1, width, wide, high)


@inline
def _composite_tiles(
    _worker, layout, records, instances, tile_starts, centres, background, ticket,
    tile_ends, transmittances, image, features, alpha, depth,
):  # fmt: skip
    """``composite`` in tiles, as long as there are any."""
    tiles_x = (features.shape[1] + TILE - 1) // TILE
    tile = take(ticket, 1)
    while tile < tile_ends.shape[0]:
        tile_ends[tile] = _composite_tile(
            layout, tile, tiles_x, records, instances, tile_starts[tile], tile_starts[tile + 1], centres,
            transmittances, image,
        )  # fmt: skip
        _write_tile(layout, tile, tiles_x, transmittances, image, background, features, alpha, depth)
        tile = take(ticket, 1)


@kernel
def composite(
    layout, workers, records, instances, tile_starts, centres, background, ticket,
    tile_ends, transmittances, image, features, alpha, depth,
):  # fmt: skip
    """Composites all tiles.

    Args:
        workers: how many threads share the tiles.
        records, instances, tile_starts: see ``binning``; block masks of instances are overwritten.
        centres: ``pixel_centres()``.
        background, ticket: [C] and [1] int64, zero.
        tile_ends: out [tiles], the end of the instances that mattered to a tile.
        transmittances, image: out [tiles * BLOCKS, modalities or channels, LANES], the final state of the pixels.
        features, alpha, depth: out [H, W, C], [M, H, W], and [H, W] where the last channel is depth, else [0, 0].
    """
    parallel_for(
        _composite_tiles, workers,
        (layout, records, instances, tile_starts, centres, background, ticket,
         tile_ends, transmittances, image, features, alpha, depth),
    )  # fmt: skip


@inline
def _reached_in_tile(
    layout, tile, tiles_x, records, instances, begin, end, centres, transmittances, shares, worker, state, numbers, depths
):  # fmt: skip
    """Fills ``depths`` at the pixels of a tile. Rows of a block's state: transmittance, final opacity, the awaited one."""
    for block in range(BLOCKS):
        here, opacity = worker * BLOCKS + block, 1.0 - load_vector(transmittances, tile * BLOCKS + block)
        store_vector(state, 3 * here, splat(1.0))
        store_vector(state, 3 * here + 1, opacity)
        store_vector(state, 3 * here + 2, opacity * shares[0])
        for lane in range(LANES):
            numbers[here, lane] = 0
    for instance in range(begin, end):
        prefetch(records, (instances[min(instance + AHEAD, end - 1), 0] & 0xFFFFFFFF) * records.shape[1])
        rank, blocks = instances[instance, 0] & 0xFFFFFFFF, instances[instance, 1]
        corner = _corner(records, rank, tile, tiles_x)
        while blocks != 0:
            block = lowest_bit(blocks)
            blocks &= blocks - 1
            here = worker * BLOCKS + block
            u1, u2 = _whitened(records, rank, corner, centres, block)
            density, passed = _density(records, rank, u1, u2)
            _, _, after, _ = _take(density, passed, load_vector(state, 3 * here))
            store_vector(state, 3 * here, after)
            reached = bits(1.0 - absolute(after) >= load_vector(state, 3 * here + 2))
            while reached != 0:
                lane = lowest_bit(reached)
                reached &= reached - 1
                x = tile % tiles_x * TILE + block % TILE_BLOCKS * BLOCK + lane % BLOCK
                y = tile // tiles_x * TILE + block // TILE_BLOCKS * BLOCK + lane // BLOCK
                opacity = np.float32(1.0) - abs(load_scalar(state, 3 * here * LANES + lane))
                whole, number = load_scalar(state, (3 * here + 1) * LANES + lane), numbers[here, lane]
                awaited = np.float32(2.0)  # never reached
                while number < shares.shape[0]:
                    awaited = whole * shares[number]
                    if opacity < awaited:
                        break
                    if x < depths.shape[1] and y < depths.shape[0]:
                        depths[y, x, number] = records[rank, feature_column(layout)]
                    awaited = np.float32(2.0)
                    number += 1
                numbers[here, lane] = number
                store_scalar(state, (3 * here + 2) * LANES + lane, awaited)


@inline
def _reached_in_tiles(
    worker, layout, records, instances, tile_starts, tile_ends, centres, transmittances, shares, ticket,
    state, numbers, depths,
):  # fmt: skip
    """``depths_at_shares`` in tiles, as long as there are any."""
    tiles_x = (depths.shape[1] + TILE - 1) // TILE
    tile = take(ticket, 1)
    while tile < tile_ends.shape[0]:
        _reached_in_tile(
            layout, tile, tiles_x, records, instances, tile_starts[tile], tile_ends[tile], centres, transmittances,
            shares, worker, state, numbers, depths,
        )  # fmt: skip
        tile = take(ticket, 1)


@kernel
def depths_at_shares(
    layout, workers, records, instances, tile_starts, tile_ends, centres, transmittances, shares, ticket,
    state, numbers, depths,
):  # fmt: skip
    """Depths of the Gaussians with which pixels reach shares of the opacity that they end with.

    Args:
        layout: one channel, which is depth, of one modality.
        records ... transmittances: as ``composite`` left them.
        shares: [S] float32, increasing, above 0 and below 1.
        ticket: [1] int64, zero.
        state, numbers: scratch [workers * BLOCKS, 3, LANES] and [workers * BLOCKS, LANES] int64.
        depths: out [H, W, S]; pixels without any opacity are left or have any depth.
    """
    parallel_for(
        _reached_in_tiles, workers,
        (layout, records, instances, tile_starts, tile_ends, centres, transmittances, shares, ticket, state, numbers, depths),
    )  # fmt: skip


@inline
def _read_block(source, offset, step, row, wide, high, target, place):
    """Copies the pixels of a block into a vector, as ``_write_block`` does the other way."""
    for y in range(high):
        for x in range(wide):
            store_scalar(target, place + y * BLOCK + x, load_scalar(source, offset + y * row + x * step))


@inline
def _read_gradients(layout, tile, tiles_x, v_features, v_alpha, v_depth, maps, v_pixels, worker):
    """Copies the gradients of a tile's pixels, and maps, into blocks; those of pixels outside of the image are zero."""
    height, width, colours = v_features.shape
    size = pixel_rows(layout)
    for block in range(BLOCKS):
        left = tile % tiles_x * TILE + block % TILE_BLOCKS * BLOCK
        top = tile // tiles_x * TILE + block // TILE_BLOCKS * BLOCK
        wide, high = max(min(BLOCK, width - left), 0), max(min(BLOCK, height - top), 0)
        first, pixel = (worker * BLOCKS + block) * size, top * width + left
        if wide < BLOCK or high < BLOCK:
            for k in range(size):
                store_vector(v_pixels, first + k, splat(0.0))
        for channel in range(colours):
            offset, row = pixel * colours + channel, width * colours
            _read_block(v_features, offset, colours, row, wide, high, v_pixels, (first + channel) * LANES)
        if v_depth.shape[0] > 0:
            _read_block(v_depth, pixel, 1, width, wide, high, v_pixels, (first + colours) * LANES)
        for modality in range(modalities(layout)):
            place, offset = first + channels(layout) + modality, modality * height * width + pixel
            _read_block(v_alpha, offset, 1, width, wide, high, v_pixels, place * LANES)
        for number in range(map_count(layout)):
            place, count = first + channels(layout) + modalities(layout) + number, map_count(layout)
            _read_block(maps, pixel * count + number, count, width * count, wide, high, v_pixels, place * LANES)


@inline
def _start(layout, tile, colours, transmittances, image, v_pixels, worker, state, v_background):
    """Sets a worker's pixels to what they are before the first Gaussian; adds to the background's gradient."""
    size = pixel_rows(layout)
    for block in range(BLOCKS):
        final, here = tile * BLOCKS + block, worker * BLOCKS + block
        for modality in range(modalities(layout)):
            left = load_vector(transmittances, final * modalities(layout) + modality)
            rest = -left * load_vector(v_pixels, here * size + channels(layout) + modality)
            for channel in range(channels(layout)):
                if modality_of(layout, channel) == modality:
                    composited = load_vector(image, final * channels(layout) + channel)
                    rest = rest + composited * load_vector(v_pixels, here * size + channel)
            store_vector(state, (here * modalities(layout) + modality) * 2, splat(1.0))
            store_vector(state, (here * modalities(layout) + modality) * 2 + 1, rest)
        for channel in range(colours):
            left = load_vector(transmittances, final * modalities(layout) + modality_of(layout, channel))
            v_background[tile, channel] += total(left * load_vector(v_pixels, here * size + channel))


@inline
def _write_slot(layout, slots, slot, sums):
    """Writes the sums over lanes of a slot's columns."""
    if slot_columns(layout) <= LANES:
        store_first(slots, slot * slots.shape[1], totals(sums), slots.shape[1])
    else:
        for column in range(slot_columns(layout)):
            slots[slot, column] = total(sums[column])


@inline
def _clear_slot(slots, slot):
    for column in range(0, slots.shape[1], LANES):
        store_first(slots, slot * slots.shape[1] + column, splat(0.0), slots.shape[1] - column)


@inline
def _composite_tile_backward(
    layout, tile, tiles_x, records, instances, begin, end, centres, v_pixels, worker, state, slots
):  # fmt: skip
    """Fills the gradient slots of instances ``begin`` to ``end`` of a tile; rows of a pixel and columns have one order."""
    size = pixel_rows(layout)
    sums = registers(slot_columns(layout))
    weights, along = registers(modalities(layout)), registers(modalities(layout))
    for instance in range(begin, end):
        prefetch(records, (instances[min(instance + AHEAD, end - 1), 0] & 0xFFFFFFFF) * records.shape[1])
        rank, slot = instances[instance, 0] & 0xFFFFFFFF, instances[instance, 0] >> 32
        blocks = instances[instance, 1]
        if blocks == 0:
            _clear_slot(slots, slot)
            continue
        corner = _corner(records, rank, tile, tiles_x)
        for column in range(slot_columns(layout)):
            sums[column] = splat(0.0)
        while blocks != 0:
            block = lowest_bit(blocks)
            blocks &= blocks - 1
            here = worker * BLOCKS + block
            u1, u2 = _whitened(records, rank, corner, centres, block)
            density, reached = _density(records, rank, u1, u2)
            for modality in range(modalities(layout)):
                along[modality] = splat(0.0)
            for channel in range(channels(layout)):
                modality = modality_of(layout, channel)
                feature = records[rank, feature_column(layout) + channel]
                along[modality] = along[modality] + feature * load_vector(v_pixels, here * size + channel)
            g = splat(0.0)
            for modality in range(modalities(layout)):
                alpha, passed = _alpha(layout, modality, records, rank, density, reached)
                unclamped = alpha < ALPHA_MAX
                place = (here * modalities(layout) + modality) * 2
                alpha, weight, after, taken = _take(alpha, passed, load_vector(state, place))
                gain = weight * along[modality]
                rest = load_vector(state, place + 1) - gain
                store_vector(state, place, after)
                store_vector(state, place + 1, rest)
                weights[modality] = weight
                # One mask at a time: a skipped alpha is 0, and LLVM narrows and widens masks that it joins for AVX2.
                ratio = select(taken, alpha / (1.0 - alpha), 0.0)
                v_log_alpha = select(unclamped, gain - rest * ratio, 0.0)
                column = OPACITY_GRADIENTS + modality
                sums[column] = sums[column] + v_log_alpha
                g = g + v_log_alpha
                if has_absgrad(layout):
                    g1, g2 = v_log_alpha * u1, v_log_alpha * u2
                    by_x, by_y = g1 * records[rank, FIRST], g1 * records[rank, MIXED] + g2 * records[rank, SECOND]
                    column = slot_columns(layout) - 2
                    sums[column] = sums[column] + absolute(by_x)
                    sums[column + 1] = sums[column + 1] + absolute(by_y)
            g1, g2 = g * u1, g * u2
            sums[0] = sums[0] + g1
            sums[1] = sums[1] + g2
            sums[2] = sums[2] + g1 * u1
            sums[3] = sums[3] + g1 * u2
            sums[4] = sums[4] + g2 * u2
            for channel in range(channels(layout)):
                column = OPACITY_GRADIENTS + modalities(layout) + channel
                v_pixel = load_vector(v_pixels, here * size + channel)
                sums[column] = sums[column] + weights[modality_of(layout, channel)] * v_pixel
            for number in range(map_count(layout)):
                row = channels(layout) + modalities(layout) + number
                sums[OPACITY_GRADIENTS + row] = sums[OPACITY_GRADIENTS + row] + weights[0] * load_vector(
                    v_pixels, here * size + row
                )
        _write_slot(layout, slots, slot, sums)


@inline
def _composite_tiles_backward(
    worker, layout, records, instances, tile_starts, tile_ends, centres, transmittances, image, ticket,
    v_features, v_alpha, v_depth, maps, v_pixels, state, slots, v_background,
):  # fmt: skip
    """``composite_backward`` in tiles, as long as there are any."""
    tiles_x = (v_features.shape[1] + TILE - 1) // TILE
    tile = take(ticket, 1)
    while tile < tile_ends.shape[0]:
        for channel in range(v_features.shape[2]):
            v_background[tile, channel] = 0.0
        _read_gradients(layout, tile, tiles_x, v_features, v_alpha, v_depth, maps, v_pixels, worker)
        _start(layout, tile, v_features.shape[2], transmittances, image, v_pixels, worker, state, v_background)
        _composite_tile_backward(
            layout, tile, tiles_x, records, instances, tile_starts[tile], tile_ends[tile], centres, v_pixels,
            worker, state, slots,
        )  # fmt: skip
        for instance in range(tile_ends[tile], tile_starts[tile + 1]):
            _clear_slot(slots, instances[instance, 0] >> 32)
        tile = take(ticket, 1)


@kernel
def composite_backward(
    layout, workers, records, instances, tile_starts, tile_ends, centres, transmittances, image, ticket,
    v_features, v_alpha, v_depth, maps, v_pixels, state, slots, v_background,
):  # fmt: skip
    """Fills the gradient slots of all instances.

    Args:
        records ... image: as ``composite`` left them.
        v_features, v_alpha, v_depth: [H, W, C], [M, H, W], and [H, W] where the last channel is depth, else [0, 0].
        maps: [H, W, S], S that of the layout.
        v_pixels, state: scratch [workers * BLOCKS, channels + modalities + S, LANES] and [.., 2 * modalities, LANES].
        slots: out [instances, slot_size], columns as in ``constants``.
        v_background: out [tiles, C], the gradient of the background tile by tile.
    """
    parallel_for(
        _composite_tiles_backward, workers,
        (layout, records, instances, tile_starts, tile_ends, centres, transmittances, image, ticket,
         v_features, v_alpha, v_depth, maps, v_pixels, state, slots, v_background),
    )  # fmt: skip
