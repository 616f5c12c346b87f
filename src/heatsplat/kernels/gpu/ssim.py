"""Structural similarity and absolute difference with their gradient, as heatsplat.kernels.ssim has them, for CUDA.

The window is blurred along rows and then along columns, forward for the moments of both images, backward for the slopes of the
similarity. Images [H, W, C] are read as [H, W·C], in which a neighbour lies C numbers away; programs take BLOCK of a row.
"""

from __future__ import annotations

import triton
import triton.language as tl

BLOCK = 128
HALF = tl.constexpr(5)  # taps on either side
C1, C2 = tl.constexpr(0.01**2), tl.constexpr(0.03**2)  # as losses.photometric has them
NEAR = tl.constexpr(0.25)  # as heatsplat.kernels.ssim has it


@triton.jit
def _shifts(means):
    """What is taken away from images of these ``means`` [2]: the target's mean, or from a prediction that is far off its own."""
    x_mean, y_mean = tl.load(means), tl.load(means + 1)
    return tl.where(tl.abs(x_mean - y_mean) < NEAR, y_mean, x_mean), y_mean


@triton.jit
def _shifted(image, valid, at, inside, shift):
    """Values with the shift taken away, 0 beyond the image and where a pixel does not count."""
    counts = tl.load(valid + at, mask=inside, other=0.0) > 0
    return tl.where(counts, tl.load(image + at, mask=inside, other=0.0) - shift, 0.0)


@triton.jit
def _down(plane, taps, row, column, inside, line, height):
    """A plane [H, W·C] blurred along columns, at this program's places."""
    found = tl.zeros(column.shape, tl.float32)
    for d in tl.static_range(2 * HALF + 1):
        near = row + d - HALF
        here = inside & (near >= 0) & (near < height)
        found += tl.load(taps + d) * tl.load(plane + near * line + column, mask=here, other=0.0)
    return found


@triton.jit
def _along(plane, taps, row, column, inside, line, CHANNELS: tl.constexpr):
    """A plane [H, W·C] blurred along rows, at this program's places."""
    found = tl.zeros(column.shape, tl.float32)
    for d in tl.static_range(2 * HALF + 1):
        near = column + (d - HALF) * CHANNELS
        here = inside & (near >= 0) & (near < line)
        found += tl.load(taps + d) * tl.load(plane + row * line + near, mask=here, other=0.0)
    return found


@triton.jit
def moments_of_rows(x, y, valid, means, taps, moments, line, pixels, CHANNELS: tl.constexpr, BLOCK: tl.constexpr):
    """``moments`` [5, H, W·C]: x, y, x², y² and xy blurred along rows, of images without what ``means`` [2] say."""
    row, column = tl.program_id(0), tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    inside = column < line
    x_shift, y_shift = _shifts(means)
    first = tl.zeros([BLOCK], tl.float32)
    second = tl.zeros([BLOCK], tl.float32)
    squared = tl.zeros([BLOCK], tl.float32)
    other = tl.zeros([BLOCK], tl.float32)
    product = tl.zeros([BLOCK], tl.float32)
    for d in tl.static_range(2 * HALF + 1):
        near = column + (d - HALF) * CHANNELS
        here = inside & (near >= 0) & (near < line)
        tap = tl.load(taps + d)
        a = _shifted(x, valid, row * line + near, here, x_shift)
        b = _shifted(y, valid, row * line + near, here, y_shift)
        first += tap * a
        second += tap * b
        squared += tap * a * a
        other += tap * b * b
        product += tap * a * b
    at = moments + row * line + column
    tl.store(at, first, mask=inside)
    tl.store(at + pixels, second, mask=inside)
    tl.store(at + 2 * pixels, squared, mask=inside)
    tl.store(at + 3 * pixels, other, mask=inside)
    tl.store(at + 4 * pixels, product, mask=inside)


@triton.jit
def similarity(
    x, y, valid, outside, means, taps, moments, slopes, sums, line, height, pixels, blocks, BLOCK: tl.constexpr,
):  # fmt: skip
    """``sums`` [2, programs] of |x - y| and of 1 - SSIM, and ``slopes`` [3, H, W·C] of SSIM by the moments x, x² and xy."""
    row, column = tl.program_id(0), tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    inside = column < line
    x_shift, y_shift = _shifts(means)
    x_mean = _down(moments, taps, row, column, inside, line, height)
    y_mean = _down(moments + pixels, taps, row, column, inside, line, height)
    xx = _down(moments + 2 * pixels, taps, row, column, inside, line, height)
    yy = _down(moments + 3 * pixels, taps, row, column, inside, line, height)
    xy = _down(moments + 4 * pixels, taps, row, column, inside, line, height)
    place = row * line + column
    missing = tl.load(outside + place, mask=inside, other=0.0)
    counts = tl.load(valid + place, mask=inside, other=0.0)
    x_mean -= x_shift * missing
    y_mean -= y_shift * missing
    variances = xx + x_shift * x_shift * missing - x_mean * x_mean
    variances += yy + y_shift * y_shift * missing - y_mean * y_mean
    sound = variances >= 0  # else all of them is rounding, and has no slope
    spread = tl.where(sound, variances, 0.0) + C2
    covariance = xy + x_shift * y_shift * missing - x_mean * y_mean
    x_level, y_level = x_mean + x_shift, y_mean + y_shift
    levels = x_level * x_level + y_level * y_level + C1
    luminance = (2 * x_level * y_level + C1) / levels
    structure = (2 * covariance + C2) / spread
    by_mean = structure * 2 * (y_level - x_level * luminance) / levels
    by_square = tl.where(sound, -luminance * structure / spread, 0.0)
    by_mean -= 2 * (by_square * x_mean + luminance * y_mean / spread)
    at = slopes + place
    tl.store(at, counts * by_mean, mask=inside)
    tl.store(at + pixels, counts * by_square, mask=inside)
    tl.store(at + 2 * pixels, counts * luminance * 2 / spread, mask=inside)
    a, b = tl.load(x + place, mask=inside, other=0.0), tl.load(y + place, mask=inside, other=0.0)
    program = row * blocks + tl.program_id(1)
    programs = height * blocks
    tl.store(sums + program, tl.sum(tl.where(counts > 0, tl.abs(a - b), 0.0)))
    tl.store(sums + programs + program, tl.sum(counts * (1 - luminance * structure)))


@triton.jit
def slopes_of_rows(slopes, taps, blurred, line, pixels, CHANNELS: tl.constexpr, BLOCK: tl.constexpr):
    """The slopes [3, H, W·C] blurred along rows."""
    row, column = tl.program_id(0), tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    inside = column < line
    at = row * line + column
    for k in tl.static_range(3):
        found = _along(slopes + k * pixels, taps, row, column, inside, line, CHANNELS)
        tl.store(blurred + k * pixels + at, found, mask=inside)


@triton.jit
def gradient(
    x, y, valid, means, taps, blurred, weights, v_difference, v_dissimilarity, v_x, line, height, pixels,
    BLOCK: tl.constexpr,
):  # fmt: skip
    """``v_x`` [H, W·C] of weights[0] Σ|x - y| and weights[1] Σ (1 - SSIM), whose own gradients are the two ``v_``."""
    row, column = tl.program_id(0), tl.program_id(1) * BLOCK + tl.arange(0, BLOCK)
    inside = column < line
    x_shift, y_shift = _shifts(means)
    first = _down(blurred, taps, row, column, inside, line, height)
    second = _down(blurred + pixels, taps, row, column, inside, line, height)
    third = _down(blurred + 2 * pixels, taps, row, column, inside, line, height)
    place = row * line + column
    counts = tl.load(valid + place, mask=inside, other=0.0) > 0
    a, b = tl.load(x + place, mask=inside, other=0.0), tl.load(y + place, mask=inside, other=0.0)
    sign = tl.where(a > b, 1.0, 0.0) - tl.where(a < b, 1.0, 0.0)
    by_difference = tl.load(weights) * tl.load(v_difference) * sign
    by_similarity = first + 2 * (a - x_shift) * second + (b - y_shift) * third
    found = by_difference - tl.load(weights + 1) * tl.load(v_dissimilarity) * by_similarity
    tl.store(v_x + place, tl.where(counts, found, 0.0), mask=inside)
