"""Peak signal-to-noise ratio."""

from __future__ import annotations

import math

from torch import Tensor

from heatsplat.metrics.valid import valid_pixels


def psnr(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """PSNR in dB for a data range of 1; infinite for identical images, None where no pixel counts.

    **Convention:** images in [0, 1]; the squared error is averaged over the counted pixels and all channels of one
    image. The PSNR of a test set is the mean of its images' PSNR, not the PSNR of their mean error.

    Args:
        prediction, target: [H, W, C].
        mask: [H, W] bool, True where a pixel counts.
    """
    valid = valid_pixels(prediction, target, mask)
    if not valid.any():
        return None
    error = (prediction[valid].double() - target[valid].double()).square().mean().item()
    return -10.0 * math.log10(error) if error > 0 else math.inf
