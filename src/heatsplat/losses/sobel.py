"""Slopes of an image by the Sobel operator, and their magnitudes."""

from __future__ import annotations

from torch import Tensor
from torch.nn import functional

TINY = 1e-12  # under the root of the magnitude, so that a flat image has a gradient of zero and not NaN
GAIN = 8.0  # what the Sobel operator makes of a slope of 1 per pixel


def sobel(image: Tensor) -> tuple[Tensor, Tensor]:
    """Sobel derivatives along x and y, [H, W, C] each.

    **Convention:** the operator as it is usually written, with weights ±1, ±2: 8 times the slope per pixel. The image
    is continued by its border, so that the border is no edge.

    Args:
        image: [H, W, C].
    """
    padded = functional.pad(image.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0].permute(1, 2, 0)
    down = padded[:-2] + 2.0 * padded[1:-1] + padded[2:]
    along = padded[:, :-2] + 2.0 * padded[:, 1:-1] + padded[:, 2:]
    return down[:, 2:] - down[:, :-2], along[2:] - along[:-2]


def sobel_magnitude(image: Tensor) -> Tensor:
    """Norms of the Sobel derivatives, [H, W, C]; at least 1e-6, with finite gradients everywhere."""
    x, y = sobel(image)
    return (x * x + y * y + TINY).sqrt()
