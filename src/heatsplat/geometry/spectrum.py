"""How much detail pictures hold at each frequency, without the noise of the camera."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.fft import dctn
from torch import Tensor

RINGS = 64  # of a spectrum, from the mean to the finest detail that pixels hold
LOW, HIGH = (0.5, 0.7), (0.8, 1.0)  # shares of the finest frequency at which detail and noise are told apart
DROWNED = 0.75  # share of noise in the contrast from which on no detail can be told from it


def spectrum(pictures: Sequence[Tensor]) -> np.ndarray:
    """Amplitudes of detail in pictures by its frequency, summed over each of ``RINGS`` square rings, [RINGS] float64.

    **Convention:** the last ring is what varies from pixel to pixel; a picture that is reduced to 1 / r of its size keeps
    the first RINGS / r of them. Amplitudes are those of the cosine transform, which sees no edge where the left border of
    a picture meets the right one; the mean is left out.

    Noise is the same at all frequencies; detail falls with it, and at least as fast as its inverse does. What does not fall
    between ``LOW`` and ``HIGH`` is therefore noise, and its power is taken away; unless it is nearly all, so that nothing
    tells it from a picture of noise.

    Args:
        pictures: [H, W, C] each, finite; at least one.
    """
    power, count = np.zeros(RINGS), np.zeros(RINGS)
    for picture in pictures:
        waves = dctn(picture.double().numpy(), axes=(0, 1), norm="ortho")
        rows, columns = (np.arange(side) / side for side in waves.shape[:2])
        rings = (RINGS * np.maximum(rows[:, None], columns)).astype(int).ravel()
        squares = np.square(waves).mean(2).ravel()
        squares[0] = 0.0
        power += np.bincount(rings, squares, RINGS)
        count += np.bincount(rings, minlength=RINGS)
    mean = power / np.maximum(count, 1)
    noise = _noise(mean, count)
    detail = np.maximum(mean - noise, 0.0)
    if (detail * count).sum() <= (1 - DROWNED) * power.sum():
        detail = mean
    rounding = 1e-12 * sum(float(picture.double().square().mean()) for picture in pictures) / len(pictures)
    return np.where(detail > rounding, np.sqrt(detail), 0.0) * count


def _noise(mean: np.ndarray, count: np.ndarray) -> float:
    """Power of noise in each coefficient: F of F + a / u², with u the frequency, from the powers of two bands."""
    found = []
    for low, high in (LOW, HIGH):
        band = slice(round(low * RINGS), round(high * RINGS))
        found.append(((0.5 * (low + high)) ** 2, np.average(mean[band], weights=count[band] + 1e-300)))
    (low, at_low), (high, at_high) = found
    return max((at_high * high - at_low * low) / (high - low), 0.0)


def held(amplitudes: np.ndarray) -> np.ndarray:
    """Share of amplitudes up to each edge of rings, [len + 1], from 0 to 1; all 0 where there are none."""
    sums = np.concatenate([[0.0], np.cumsum(amplitudes)])
    return sums / sums[-1] if sums[-1] > 0 else sums
