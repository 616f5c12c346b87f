"""L1 and structural dissimilarity of two images in one go, forward and backward.

The plain-torch twin is heatsplat.losses.photometric (``l1`` and ``ssim_map``), which says what is computed.

An image [H, W, C] is a plane of H rows of W·C numbers; a horizontal tap is then C numbers away, and any C takes the
same code. Both blurs of a row happen while it is in the first-level cache: first down the eleven rows around it, into
a row buffer, then along that buffer. Planes have five rows of zeros above and below and whole vectors in a row, row
buffers a margin of zeros at both ends, so no loop knows borders. Rows are independent and sums are kept per row: the
number of threads changes no bit.

Images are shifted by the mean of the target, where the prediction is near it: what rounding does to both then cancels. A
prediction that is far off is shifted by its own mean, which leaves variances and covariance as they are, but exact.

SSIM asks for variances only in their sum, so four blurs do: of x, y, x² + y² and x·y. Statistics of the target are not
kept from step to step: that would save one blur (measured: 0.05 ms of 0.9 ms, at 512 x 410 on two threads) and cost two
images of memory for every view.
"""

from __future__ import annotations

import numpy as np

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.scheduling import parallel_for
from heatsplat.kernels.simd import (
    LANES,
    absolute,
    load,
    load_columns,
    load_scalar,
    select,
    splat,
    store,
    store_columns,
    total,
)

RADIUS = 5  # of the window, in pixels
TAPS = 2 * RADIUS + 1
C1, C2 = np.float32(0.01**2), np.float32(0.03**2)  # stabilisers for images in [0, 1]
NEAR = 0.25  # means less than that apart: what float32 loses of the square is below 1e-5 of C2
BLOCK = 8  # rows per parallel task
SHARE = (
    65536  # numbers per task of a pass that does little with each: waking a thread for fewer takes longer than they do
)

_ZERO, _ONE, _TWO = np.float32(0.0), np.float32(1.0), np.float32(2.0)


def plane_shape(height: int, width: int, channels: int) -> tuple[int, int]:
    """Shape of a plane: the rows and five more above and below, each a whole number of vectors."""
    return height + 2 * RADIUS, -(-width * channels // LANES) * LANES


@inline
def _blur(plane, offset, step, taps):
    """Weighted sum of eleven vectors: the first at ``offset``, the others ``step`` numbers further each."""
    blurred = splat(_ZERO)
    for k in range(TAPS):
        blurred = blurred + load_scalar(taps, k) * load(plane, offset + k * step)
    return blurred


@inline
def _missing_row(row, valid, length, step, missing):
    """What does not count in a row of the plane ``missing``."""
    for column in range(0, length, LANES):
        (counts,) = load_columns(valid, row * length + column, 1, length - column)
        store(missing, (row + RADIUS) * step + column, _ONE - counts)


@inline
def _coverage_block(block, missing, height, length, step, channels, taps, outside):
    """``coverage`` of BLOCK rows."""
    margin = RADIUS * channels
    buffer = np.ones(step + 2 * margin, np.float32)
    for row in range(block * BLOCK, min(height, (block + 1) * BLOCK)):
        for column in range(0, length, LANES):
            store(buffer, margin + column, _blur(missing, row * step + column, step, taps))
        for column in range(0, length, LANES):
            share = _blur(buffer, column, channels, taps)
            store_columns(outside, row * length + column, (share,), length - column)


@kernel
def coverage(valid, height, length, channels, taps, outside):
    """Fills ``outside`` [H·L] with the share of each pixel's window that does not count: beyond the border or masked.

    Args:
        valid: [H·L] 1 where a pixel counts, else 0.
        height, length: rows and numbers per row L = W·C.
        channels: C.
        taps: [11] of the window.
        outside: [H·L] output; exactly 0 where the whole window counts.
    """
    step = (length + LANES - 1) // LANES * LANES
    missing = np.ones((height + 2 * RADIUS) * step, np.float32)
    parallel_for(_missing_row, height, (valid, length, step, missing))
    parallel_for(
        _coverage_block, (height + BLOCK - 1) // BLOCK, (missing, height, length, step, channels, taps, outside)
    )


@inline
def _levels_of_row(row, prediction, target, valid, length, sums):
    """Sums of both images over what counts of a row, and how much counts."""
    level_x, level_y, count = splat(_ZERO), splat(_ZERO), splat(_ZERO)
    for column in range(0, length, LANES):
        at, rest = row * length + column, length - column
        (counts,) = load_columns(valid, at, 1, rest)
        (here,) = load_columns(prediction, at, 1, rest)
        (there,) = load_columns(target, at, 1, rest)
        level_x = level_x + select(counts > _ZERO, here, _ZERO)
        level_y = level_y + select(counts > _ZERO, there, _ZERO)
        count = count + counts
    sums[row, 0], sums[row, 1], sums[row, 2] = total(level_x), total(level_y), total(count)


@inline
def _levels_of_rows(share, rows, height, prediction, target, valid, length, sums):
    """``_levels_of_row`` of a share of the rows."""
    for row in range(share * rows, min(height, (share + 1) * rows)):
        _levels_of_row(row, prediction, target, valid, length, sums)


@inline
def _shift_row(row, prediction, target, valid, length, step, shift_x, shift_y, x, y, sums):
    """Writes a row of the planes; the sum of |x - y| over what counts."""
    difference = splat(_ZERO)
    for column in range(0, length, LANES):
        at, rest = row * length + column, length - column
        (counts,) = load_columns(valid, at, 1, rest)
        (here,) = load_columns(prediction, at, 1, rest)
        (there,) = load_columns(target, at, 1, rest)
        difference = difference + select(counts > _ZERO, absolute(here - there), _ZERO)
        inner = (row + RADIUS) * step + column
        store(x, inner, select(counts > _ZERO, here - shift_x, _ZERO))
        store(y, inner, select(counts > _ZERO, there - shift_y, _ZERO))
    sums[row, 0] = total(difference)


@inline
def _shift_rows(share, rows, height, prediction, target, valid, length, step, shift_x, shift_y, x, y, sums):
    """``_shift_row`` of a share of the rows."""
    for row in range(share * rows, min(height, (share + 1) * rows)):
        _shift_row(row, prediction, target, valid, length, step, shift_x, shift_y, x, y, sums)


@inline
def _forward_block(block, valid, outside, height, length, step, channels, taps, shift_x, shift_y, x, y, slopes, sums):
    """The sums of 1 - SSIM and the slopes of BLOCK rows."""
    plane = (height + 2 * RADIUS) * step
    margin = RADIUS * channels
    span = step + 2 * margin
    buffer = np.zeros(4 * span, np.float32)
    for row in range(block * BLOCK, min(height, (block + 1) * BLOCK)):
        for column in range(0, length, LANES):
            blur_x, blur_y, blur_squares, blur_xy = splat(_ZERO), splat(_ZERO), splat(_ZERO), splat(_ZERO)
            for k in range(TAPS):
                at, tap = (row + k) * step + column, load_scalar(taps, k)
                here, there = load(x, at), load(y, at)
                weighted_here, weighted_there = tap * here, tap * there
                blur_x = blur_x + weighted_here
                blur_y = blur_y + weighted_there
                blur_squares = blur_squares + weighted_here * here + weighted_there * there
                blur_xy = blur_xy + weighted_here * there
            store(buffer, margin + column, blur_x)
            store(buffer, span + margin + column, blur_y)
            store(buffer, 2 * span + margin + column, blur_squares)
            store(buffer, 3 * span + margin + column, blur_xy)

        dissimilarity = splat(_ZERO)
        for column in range(0, length, LANES):
            (counts,) = load_columns(valid, row * length + column, 1, length - column)
            (missing,) = load_columns(outside, row * length + column, 1, length - column)
            away_x = _blur(buffer, column, channels, taps) - shift_x * missing  # means, minus the shifts
            away_y = _blur(buffer, span + column, channels, taps) - shift_y * missing
            squares = _blur(buffer, 2 * span + column, channels, taps)
            products = _blur(buffer, 3 * span + column, channels, taps)
            mean_x, mean_y = away_x + shift_x, away_y + shift_y
            # What lies outside is 0, so minus the shifts its squares and its product are theirs.
            variances = squares + (shift_x * shift_x + shift_y * shift_y) * missing - away_x * away_x - away_y * away_y
            covariance = products + shift_x * shift_y * missing - away_x * away_y
            sound = variances >= _ZERO  # else all of them is rounding, and has no slope
            variances = select(sound, variances, _ZERO)

            inverse_levels = _ONE / (mean_x * mean_x + mean_y * mean_y + C1)
            inverse_variances = _ONE / (variances + C2)
            luminance = (_TWO * mean_x * mean_y + C1) * inverse_levels
            structure = (_TWO * covariance + C2) * inverse_variances
            similarity = luminance * structure
            dissimilarity = dissimilarity + counts * (_ONE - similarity)

            by_squares = -select(sound, counts, _ZERO) * similarity * inverse_variances
            by_xy = counts * _TWO * luminance * inverse_variances
            by_mean = counts * _TWO * structure * (mean_y - mean_x * luminance) * inverse_levels
            inner = (row + RADIUS) * step + column
            store(slopes, inner, by_mean - _TWO * by_squares * away_x - by_xy * away_y)
            store(slopes, plane + inner, by_squares)
            store(slopes, 2 * plane + inner, by_xy)
        sums[row, 1] = total(dissimilarity)


@kernel
def forward(prediction, target, valid, outside, height, length, channels, taps, x, y, slopes):
    """Sums of |x - y| and of 1 - SSIM over what counts, and what ``backward`` needs.

    Args:
        prediction, target, valid, outside: [H·L] images, 1 where a pixel counts, and what ``coverage`` gave.
        height, length, channels, taps: as in ``coverage``.
        x, y: planes; receive the images minus their shifts, 0 where a pixel does not count.
        slopes: three planes; receive the derivatives of SSIM with respect to the blurs of x, x² + y² and x·y.

    Returns:
        The two sums, float64.
    """
    step = (length + LANES - 1) // LANES * LANES
    plane = (height + 2 * RADIUS) * step
    sums = np.empty((height, 3))

    # The shifts: means of the images, where they count
    rows = max(1, SHARE // length)
    shares = (height + rows - 1) // rows
    parallel_for(_levels_of_rows, shares, (rows, height, prediction, target, valid, length, sums))
    level_x, level_y, count = 0.0, 0.0, 0.0
    for row in range(height):
        level_x += sums[row, 0]
        level_y += sums[row, 1]
        count += sums[row, 2]
    shift_x, shift_y = np.float32(level_x / max(count, 1.0)), np.float32(level_y / max(count, 1.0))
    if abs(shift_x - shift_y) < NEAR:
        shift_x = shift_y

    zeros = splat(_ZERO)
    parallel_for(
        _shift_rows, shares, (rows, height, prediction, target, valid, length, step, shift_x, shift_y, x, y, sums)
    )
    for border in range(0, RADIUS * step, LANES):
        for at in (border, plane - LANES - border):
            store(x, at, zeros)
            store(y, at, zeros)
            for k in range(3):
                store(slopes, k * plane + at, zeros)

    parallel_for(
        _forward_block,
        (height + BLOCK - 1) // BLOCK,
        (valid, outside, height, length, step, channels, taps, shift_x, shift_y, x, y, slopes, sums),
    )
    difference, dissimilarity = 0.0, 0.0
    for row in range(height):
        difference += sums[row, 0]
        dissimilarity += sums[row, 1]
    return difference, dissimilarity


@inline
def _backward_block(
    block, prediction, target, valid, height, length, channels, taps, x, y, slopes, v_l1, v_dssim, v_prediction
):
    """``backward`` of BLOCK rows."""
    step = (length + LANES - 1) // LANES * LANES
    plane = (height + 2 * RADIUS) * step
    margin = RADIUS * channels
    span = step + 2 * margin
    weight_l1 = splat(v_l1)
    buffer = np.zeros(3 * span, np.float32)
    for row in range(block * BLOCK, min(height, (block + 1) * BLOCK)):
        for column in range(0, length, LANES):
            for k in range(3):
                blurred = _blur(slopes, k * plane + row * step + column, step, taps)
                store(buffer, k * span + margin + column, blurred)
        for column in range(0, length, LANES):
            at, rest, inner = row * length + column, length - column, (row + RADIUS) * step + column
            slope = _blur(buffer, column, channels, taps)
            slope = slope + _TWO * load(x, inner) * _blur(buffer, span + column, channels, taps)
            slope = slope + load(y, inner) * _blur(buffer, 2 * span + column, channels, taps)
            (counts,) = load_columns(valid, at, 1, rest)
            (here,) = load_columns(prediction, at, 1, rest)
            (there,) = load_columns(target, at, 1, rest)
            sign = select(here > there, weight_l1, _ZERO) - select(here < there, weight_l1, _ZERO)
            store_columns(v_prediction, at, (select(counts > _ZERO, sign - v_dssim * slope, _ZERO),), rest)


@kernel
def backward(prediction, target, valid, height, length, channels, taps, x, y, slopes, v_l1, v_dssim, v_prediction):
    """Fills ``v_prediction`` [H·L] with the gradient of v_l1 · sum |x - y| + v_dssim · sum (1 - SSIM).

    Args: as in ``forward``, whose x, y and slopes it reads.
    """
    parallel_for(
        _backward_block,
        (height + BLOCK - 1) // BLOCK,
        (prediction, target, valid, height, length, channels, taps, x, y, slopes, v_l1, v_dssim, v_prediction),
    )
