"""Losses on the differences between neighbouring pixels: agreement of edges, and smoothness guided by another image."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.losses.compose import LossInputs, LossTerm
from heatsplat.losses.masking import cleared, masked_mean


def slopes(image: Tensor) -> tuple[Tensor, Tensor]:
    """Differences to the right and the lower neighbour, [H, W, C] each; zero in the last column and row.

    Args:
        image: [H, W, C].
    """
    right, down = torch.zeros_like(image), torch.zeros_like(image)
    right[:, :-1] = image[:, 1:] - image[:, :-1]
    down[:-1] = image[1:] - image[:-1]
    return right, down


def gradient_difference(prediction: Tensor, target: Tensor) -> Tensor:
    """1/2 (|∂x prediction - ∂x target| + |∂y prediction - ∂y target|), [H, W, C] (RaViGS, Eq. 13, before the mean)."""
    right, down = slopes(prediction - target)
    return 0.5 * (right.abs() + down.abs())


def guided_variation(image: Tensor, guide: Tensor, beta: float) -> Tensor:
    """|∇image| e^{-β |∇guide|}, [H, W, C]: where the guide has an edge, the image may have one too (RaViGS, Eq. 16).

    **Convention:** |∇| is the sum of the absolute slopes along x and y; that of the guide is the mean of its channels',
    so that β means the same for grey and colour. Images in [0, 1], β without a unit.

    Args:
        image: [H, W, C] what is smoothed.
        guide: [H, W, G] what says where not.
        beta: β; 0 smooths everywhere.
    """
    edges = sum(slope.abs() for slope in slopes(guide)).mean(-1, keepdim=True)
    return sum(slope.abs() for slope in slopes(image)) * torch.exp(-beta * edges)


class GradientConsistency(LossTerm):
    """The mean of ``gradient_difference`` over pixels and channels.

    Pixels that, or whose right or lower neighbour, are masked do not count.

    Args:
        modality: which image: that of a companion, such as "rgb", or None for the model's own.
    """

    def __init__(self, modality: str | None = None) -> None:
        self.modality = modality

    def __call__(self, inputs: LossInputs) -> Tensor:
        prediction, target = (cleared(image, inputs.mask) for image in inputs.pair(self.modality))
        return masked_mean(gradient_difference(prediction, target), _with_neighbours(inputs.mask))


class GuidedVariation(LossTerm):
    """The mean of ``guided_variation`` of the prediction over pixels and channels, guided by a companion's target.

    Pixels that, or whose right or lower neighbour, are masked do not count.

    Args:
        guide: companion whose target guides, such as "rgb".
        beta: how fast an edge of the guide lifts the constraint, 0 or more.
        modality: which image is smoothed: that of a companion, or None for the model's own.

    Raises:
        ValueError: ``beta`` is negative.
    """

    def __init__(self, guide: str, beta: float = 10.0, modality: str | None = None) -> None:
        if beta < 0:
            raise ValueError(f"beta must not be negative, got {beta}")
        self.guide, self.beta, self.modality = guide, beta, modality

    def __call__(self, inputs: LossInputs) -> Tensor:
        prediction = cleared(inputs.pair(self.modality)[0], inputs.mask)
        guide = cleared(inputs.pair(self.guide)[1], inputs.mask)
        return masked_mean(guided_variation(prediction, guide, self.beta), _with_neighbours(inputs.mask))


def _with_neighbours(mask: Tensor | None) -> Tensor | None:
    """Which pixels [H, W] count together with their right and their lower neighbour."""
    if mask is None:
        return None
    counted = mask.clone()
    counted[:, :-1] &= mask[:, 1:]
    counted[:-1] &= mask[1:]
    return counted
