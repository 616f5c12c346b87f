"""Sums of the gradient slots of Gaussians, sixteen Gaussians at a time.

A Gaussian's slots lie side by side and are added one after the other, so the result depends on nothing but the image: not on
threads, not on the run. Gaussians are taken in their own order, in which all that is read and written besides the slots lies
side by side; slots lie in the order of depth, so those of the next Gaussians are fetched ahead.
"""

from __future__ import annotations

import numpy as np

from heatsplat.kernels.compilation import inline
from heatsplat.kernels.constants import (
    ALPHA_MIN,
    DEPTH_GRADIENT,
    LOG_OPACITY_GRADIENT,
    OPACITY_GRADIENTS,
    SUMS,
    TWO_LN_2,
)
from heatsplat.kernels.simd import LANES, load, lowest_bit, prefetch, splat, store


@inline
def fetch_slots(first, lanes, spans, slots):
    """Asks for the slots of the Gaussians ``first`` + each set bit of ``lanes``."""
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes &= lanes - 1
        begin, end = np.int64(spans[first + lane, 0]), np.int64(spans[first + lane, 1])
        for place in range(begin * slots.shape[1], end * slots.shape[1], LANES):
            prefetch(slots, place)


@inline
def clear_invisible(first, count, lanes, rows_are_ranks, v_opacities, v_features, absgrad):
    """Zeros for those of ``count`` Gaussians from ``first`` on whose bit of ``lanes`` is not set."""
    for lane in range(count):
        if (lanes >> lane) & 1:
            continue
        for modality in range(v_opacities.shape[0]):
            v_opacities[modality, first + lane] = 0.0
        for channel in range(0 if rows_are_ranks else v_features.shape[1]):
            v_features[first + lane, channel] = 0.0
        for axis in range(absgrad.shape[1]):
            absgrad[first + lane, axis] = 0.0


@inline
def sum_slots(
    first, lanes, row, spans, slots, opacities, raw, with_depth, rows_are_ranks, sums, place,
    v_opacities, v_features, maps, absgrad,
):  # fmt: skip
    """Adds up the slots of sixteen Gaussians and finishes the gradients that need no projection; the next row.

    Args:
        first, lanes: the first of the Gaussians, and bits of the visible ones.
        row: the row of the first visible one in what is given for the visible ones only.
        spans: [N, 2] the first slot of a Gaussian and the one after its last.
        slots: [slots, slot_size].
        raw: whether gradients of opacities are those of their logits.
        opacities, v_opacities: [M, N]; v_features: [N, C], or [n, C] where ``rows_are_ranks``; maps: [n, S];
            absgrad: [N, 2] or [0, 0].
        sums: scratch, of which sixteen rows of SUMS numbers from ``place`` on are filled for the visible ones, and which has
            room for a slot after them.
    """
    size, modalities, colours = slots.shape[1], opacities.shape[0], v_features.shape[1]
    whole = place + LANES * SUMS
    while lanes != 0:
        lane = lowest_bit(lanes)
        lanes &= lanes - 1
        gaussian = first + lane
        begin, end = np.int64(spans[gaussian, 0]), np.int64(spans[gaussian, 1])
        for column in range(0, size, LANES):
            added = splat(0.0)
            for slot in range(begin, end):
                added = added + load(slots, slot * size + column)
            store(sums, whole + column, added)
        mine = place + lane * SUMS
        for column in range(OPACITY_GRADIENTS):
            sums[mine + column] = sums[whole + column]
        column = whole + OPACITY_GRADIENTS
        of_all = np.float32(0.0)
        for modality in range(modalities):
            v_log_opacity = sums[column + modality]
            opacity = opacities[modality, gaussian]
            v_opacity = v_log_opacity * (np.float32(1.0) - opacity) if raw else v_log_opacity / opacity
            v_opacities[modality, gaussian] = v_opacity if opacity >= ALPHA_MIN else np.float32(0.0)
            of_all += v_log_opacity
        sums[mine + LOG_OPACITY_GRADIENT] = of_all
        column += modalities
        target = row if rows_are_ranks else gaussian
        for channel in range(colours):
            v_features[target, channel] = sums[column + channel]
        column += colours
        sums[mine + DEPTH_GRADIENT] = sums[column] if with_depth else np.float32(0.0)
        column += np.int64(with_depth)
        for number in range(maps.shape[1]):
            maps[row, number] = sums[column + number]
        column += maps.shape[1]
        for axis in range(absgrad.shape[1]):
            absgrad[gaussian, axis] = sums[column + axis] * TWO_LN_2
        row += 1
    return row
