"""Smoothness of one image: differences of every pixel from its four neighbours (ThermalGaussian)."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.losses.compose import LossInputs, LossTerm
from heatsplat.losses.masking import cleared, masked_mean


def neighbour_differences(image: Tensor, mask: Tensor | None = None) -> Tensor:
    """Sum of |pixel - neighbour| over the upper, lower, left and right neighbour, [H, W, C].

    **Convention:** neighbours are constants, so that a pixel is drawn to their median. A neighbour that lies outside of
    the image, or does not count, differs by nothing.

    Args:
        image: [H, W, C].
        mask: [H, W] bool, True where a pixel counts; None means that all do.
    """
    image = cleared(image, mask)
    still = image.detach()
    total = torch.zeros_like(image)
    for axis in (0, 1):
        length = image.shape[axis] - 1
        for here, there in ((1, 0), (0, 1)):
            difference = (image.narrow(axis, here, length) - still.narrow(axis, there, length)).abs()
            if mask is not None:
                both = mask.narrow(axis, 0, length) & mask.narrow(axis, 1, length)
                difference = torch.where(both[..., None], difference, 0.0)
            total.narrow(axis, here, length).add_(difference)
    return total


class Smoothness(LossTerm):
    """The mean of ``neighbour_differences`` of the prediction over the pixels that count and their channels.

    ThermalGaussian's smoothness term; its code takes the neighbours beyond the border from the other side of the image.

    Args:
        modality: which image: that of a companion, such as "rgb", or None for the model's own.
    """

    def __init__(self, modality: str | None = None) -> None:
        self.modality = modality

    def __call__(self, inputs: LossInputs) -> Tensor:
        prediction = inputs.pair(self.modality)[0]
        return masked_mean(neighbour_differences(prediction, inputs.mask), inputs.mask)
