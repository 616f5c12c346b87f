"""Brightness corrected by a curve, forward and backward: I (1 + g(b)) + o(b), where b is the mean of a pixel's channels.

The plain-torch twin is heatsplat.sensors.tone.corrected_reference, which says what is computed.

The curve is a table of g and o at evenly spaced brightnesses, which stays in the first-level cache. The gradient of a table is
summed in as many tables as there are blocks of pixels, and these are added up in order: the number of threads changes no bit.
"""

from __future__ import annotations

import numpy as np

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.scheduling import parallel_for

BLOCK = 8192  # pixels per parallel task

_ZERO, _ONE = np.float32(0.0), np.float32(1.0)


@inline
def _interval(pixel, image, channels, last):
    """The interval of the table a pixel falls into, how far into it in [0, 1], and whether its brightness is inside."""
    brightness = image[pixel * channels]
    for channel in range(1, channels):
        brightness += image[pixel * channels + channel]
    place = brightness * (np.float32(last) / np.float32(channels))
    inside = (place > _ZERO) & (place < np.float32(last))
    if not place > _ZERO:  # NaN, too, which is no number of an interval
        place = _ZERO
    if place > np.float32(last):
        place = np.float32(last)
    k = min(np.int64(place), last - 1)
    return k, place - np.float32(k), inside


@inline
def _correct_block(block, image, channels, curve, corrected):
    """Writes a block of pixels."""
    last = curve.shape[0] - 1
    for pixel in range(block * BLOCK, min(image.shape[0] // channels, (block + 1) * BLOCK)):
        k, share, _ = _interval(pixel, image, channels, last)
        factor = _ONE + curve[k, 0] + share * (curve[k + 1, 0] - curve[k, 0])
        offset = curve[k, 1] + share * (curve[k + 1, 1] - curve[k, 1])
        for place in range(pixel * channels, (pixel + 1) * channels):
            corrected[place] = image[place] * factor + offset


@kernel
def correct(image, channels, curve, corrected):
    """Fills ``corrected``.

    Args:
        image: [P·C] float32.
        channels: C.
        curve: [L, 2] float32, g and o at L >= 2 brightnesses from 0 to 1, with straight lines between; the ends hold beyond.
        corrected: [P·C] output.
    """
    blocks = (image.shape[0] // channels + BLOCK - 1) // BLOCK
    parallel_for(_correct_block, blocks, (image, channels, curve, corrected))


@inline
def _differentiate_block(block, image, channels, curve, grad, v_image, tables):
    """Writes a block of pixels' gradients, and its table."""
    last = curve.shape[0] - 1
    for level in range(last + 1):
        tables[block, level, 0] = tables[block, level, 1] = _ZERO
    for pixel in range(block * BLOCK, min(image.shape[0] // channels, (block + 1) * BLOCK)):
        k, share, inside = _interval(pixel, image, channels, last)
        v_factor, v_offset = _ZERO, _ZERO
        for place in range(pixel * channels, (pixel + 1) * channels):
            v_factor += grad[place] * image[place]
            v_offset += grad[place]
        tables[block, k, 0] += (_ONE - share) * v_factor
        tables[block, k, 1] += (_ONE - share) * v_offset
        tables[block, k + 1, 0] += share * v_factor
        tables[block, k + 1, 1] += share * v_offset
        rise, lift = curve[k + 1, 0] - curve[k, 0], curve[k + 1, 1] - curve[k, 1]
        by_brightness = _ZERO
        if inside:
            by_brightness = (v_factor * rise + v_offset * lift) * np.float32(last) / np.float32(channels)
        factor = _ONE + curve[k, 0] + share * rise
        for place in range(pixel * channels, (pixel + 1) * channels):
            v_image[place] = grad[place] * factor + by_brightness


@kernel
def differentiate(image, channels, curve, grad, v_image, v_curve):
    """Fills the gradients of ``correct`` in the image and in the curve.

    Args:
        image, channels, curve: as for ``correct``.
        grad: [P·C] gradient of the corrected image.
        v_image: [P·C] output; by way of brightness only where it lies between the ends of the curve.
        v_curve: [L, 2] output.
    """
    blocks = (image.shape[0] // channels + BLOCK - 1) // BLOCK
    tables = np.empty((blocks, curve.shape[0], 2), np.float32)
    parallel_for(_differentiate_block, blocks, (image, channels, curve, grad, v_image, tables))
    for level in range(curve.shape[0]):
        for column in range(2):
            found = 0.0
            for block in range(blocks):
                found += tables[block, level, column]
            v_curve[level, column] = found
