"""Peak signal-to-noise ratio."""

from __future__ import annotations

import math

from torch import Tensor

from heatsplat.metrics.valid import valid_pixels

# An error of 1e-5 of the range, less than half a millikelvin of 50: what no camera tells from none. Without an end, one view that
# is the same everywhere, such as one that the bounds cut off, would leave a run without a score.
MOST_DB = 100.0


def psnr(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """PSNR in dB for a data range of 1, 100 at most, as of identical images; None where no pixel counts.

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
    return min(-10.0 * math.log10(error), MOST_DB) if error > 0 else MOST_DB
