"""What is shown of values outside the range of an image, and whether they learn."""

from __future__ import annotations

import torch
from torch import Tensor

CLIPS = ("straight_through", "hard", "none")


def clipped(values: Tensor, clip: str) -> Tensor:
    """Values as an image in [0, 1] shows them, any shape.

    Args:
        values: what is emitted.
        clip: "straight_through" clamps values but lets gradients pass, so that a value outside comes back; "hard" stops
            its gradient; "none" shows it as it is.
    """
    if clip == "straight_through":
        return _StraightThroughClamp.apply(values)
    return values.clamp(0, 1) if clip == "hard" else values


class _StraightThroughClamp(torch.autograd.Function):
    """Values clamped to [0, 1] with the gradient of the identity."""

    @staticmethod
    def forward(ctx, values: Tensor) -> Tensor:
        return values.clamp(0, 1)

    @staticmethod
    def backward(ctx, grad: Tensor) -> Tensor:
        return grad
