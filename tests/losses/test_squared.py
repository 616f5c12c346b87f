"""Mean squared errors by hand, with and without a mask."""

import pytest
import torch

from heatsplat.losses.compose import LossInputs
from heatsplat.losses.squared import Squared


def found(prediction, target, mask=None):
    term = Squared()(LossInputs(prediction, target, mask, None, None, 0, 0.0, {}))
    return term["squared"]


def test_the_mean_is_over_channels_of_pixels_that_count():
    prediction = torch.tensor([[[1.0, 2.0], [0.0, 5.0]]], requires_grad=True)
    target = torch.tensor([[[0.0, 0.0], [0.0, 1.0]]])
    assert found(prediction, target).item() == pytest.approx((1 + 4 + 0 + 16) / 4)
    mask = torch.tensor([[True, False]])
    term = found(prediction, torch.where(mask[..., None], target, torch.nan), mask)
    assert term.item() == pytest.approx(2.5)
    term.backward()
    assert prediction.grad.tolist() == [[[1.0, 2.0], [0.0, 0.0]]]
    assert found(prediction, target, torch.zeros(1, 2, dtype=torch.bool)).item() == 0.0
