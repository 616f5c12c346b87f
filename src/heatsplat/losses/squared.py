"""The mean squared error of an image, the loss of radiance fields."""

from __future__ import annotations

from torch import Tensor

from heatsplat.losses.compose import LossInputs, LossTerm
from heatsplat.losses.masking import cleared
from heatsplat.same_bits import mean, total


class Squared(LossTerm):
    """The term "squared": the mean of (x - y)² over the channels of the pixels that count; 0 where none does.

    Args:
        modality: which image: that of a companion, such as "rgb", or None for the model's own.
    """

    def __init__(self, modality: str | None = None) -> None:
        self.modality = modality

    def __call__(self, inputs: LossInputs) -> dict[str, Tensor]:
        (prediction, target), mask = inputs.pair(self.modality), inputs.mask
        if mask is None:
            return {"squared": mean((prediction - target).square())}
        errors = (cleared(prediction, mask) - cleared(target, mask)).square()
        return {"squared": total(errors.mean(-1)) / mask.sum().clamp(min=1)}
