"""Structural similarity."""

from __future__ import annotations

import cv2
import numpy as np
from torch import Tensor

from heatsplat.metrics.valid import valid_pixels

WINDOW = 11  # taps of the Gaussian window, sigma 1.5 pixels: the window of Wang et al. 2004 and of the 3DGS scripts
_WEIGHTS = np.exp(-0.5 * ((np.arange(WINDOW) - WINDOW // 2) / 1.5) ** 2)
_TAPS = _WEIGHTS / _WEIGHTS.sum()
C1, C2 = 0.01**2, 0.03**2


def ssim(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Mean SSIM of one image; None where no window counts.

    **Convention:** images in [0, 1]; Gaussian window of 11 x 11 taps with sigma 1.5, C1 = 0.01², C2 = 0.03²; averaged
    over the windows that lie wholly within the image and within the mask, and over channels. skimage counts the same
    windows; the 3DGS scripts pad with zeros and torchmetrics mirrors, and both average the padded border too. In
    float64, because E[x²] - E[x]² of a nearly constant image drowns in float32.

    Args:
        prediction, target: [H, W, C].
        mask: [H, W] bool, True where a pixel counts.

    Source: Wang et al., Image Quality Assessment (2004), Eq. 13.
    """
    valid = valid_pixels(prediction, target, mask).cpu().numpy()
    if min(valid.shape) < WINDOW:
        return None
    whole = _inner(cv2.erode(valid.astype(np.uint8), np.ones((WINDOW, WINDOW), np.uint8))) > 0
    if not whole.any():
        return None
    # Values outside the mask reach no window that counts; zero keeps NaN from reaching any.
    x, y = (np.where(valid[..., None], image.double().cpu().numpy(), 0.0) for image in (prediction, target))
    mean_x, mean_y, xx, yy, xy = (_means(values) for values in (x, y, x * x, y * y, x * y))
    scores = (2 * mean_x * mean_y + C1) * (2 * (xy - mean_x * mean_y) + C2)
    scores /= (mean_x**2 + mean_y**2 + C1) * (xx - mean_x**2 + yy - mean_y**2 + C2)
    return float(scores[whole].mean())


def _means(values: np.ndarray) -> np.ndarray:
    """Weighted means [H - 10, W - 10, C] over the windows that lie wholly within an image [H, W, C]."""
    found = cv2.sepFilter2D(values, cv2.CV_64F, _TAPS, _TAPS)
    return _inner(found.reshape(values.shape))


def _inner(image: np.ndarray) -> np.ndarray:
    """An image without the pixels in whose windows others are missing."""
    edge = WINDOW // 2
    return image[edge:-edge, edge:-edge]
