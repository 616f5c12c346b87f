"""Structural similarity."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from kornia.metrics import ssim as ssim_map
from torch import Tensor

from heatsplat.metrics.valid import valid_pixels

WINDOW = 11  # taps of the Gaussian window, sigma 1.5 pixels: the window of Wang et al. 2004 and of the 3DGS scripts


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
    valid = valid_pixels(prediction, target, mask)
    if min(valid.shape) < WINDOW:
        return None
    whole = -F.max_pool2d(-valid[None].double(), WINDOW, stride=1)[0] > 0.5
    if not whole.any():
        return None
    # Values outside the mask reach no window that counts; zero keeps NaN from reaching any.
    images = [
        torch.where(valid[..., None], image.double(), 0.0).permute(2, 0, 1)[None] for image in (prediction, target)
    ]
    scores = ssim_map(*images, window_size=WINDOW, eps=0.0, padding="valid")
    return scores[0][:, whole].mean().item()
