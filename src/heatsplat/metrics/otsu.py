"""Otsu's threshold between the warm and the cold part of an image."""

from __future__ import annotations

import torch
from skimage.filters import threshold_otsu
from torch import Tensor

LEVELS = 255


def grey_levels(image: Tensor) -> Tensor:
    """The 8-bit grey levels of an image in [0, 1], uint8, any shape. Both papers threshold 8-bit images."""
    return (image.clamp(0, 1) * LEVELS).round().to(torch.uint8)


def otsu_level(image: Tensor, mask: Tensor | None = None) -> int | None:
    """The grey level 0..255 that separates two classes best; the brighter class lies strictly above it.

    None where no pixel counts or all counted pixels have one grey level: then there are no two classes, and hence no
    region of interest.

    Args:
        image: [H, W, 1] or [H, W] in [0, 1]; NaN is not counted.
        mask: [H, W] bool, True where a pixel counts.

    Source: Otsu, A Threshold Selection Method from Gray-Level Histograms (1979).
    """
    image = image.reshape(image.shape[:2])
    known = torch.isfinite(image) if mask is None else torch.isfinite(image) & mask.to(image.device)
    levels = grey_levels(image[known])
    if levels.numel() == 0 or levels.min() == levels.max():
        return None
    return int(threshold_otsu(levels.cpu().numpy()))
