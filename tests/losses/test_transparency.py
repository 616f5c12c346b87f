"""Penalties on opacity and size: their values, and that size counts in extents of the scene."""

from types import SimpleNamespace

import pytest
import torch

from heatsplat.losses.compose import LossInputs
from heatsplat.losses.transparency import MeanOpacity, MeanSize
from heatsplat.splats import Splats


def inputs(scale: float = 1.0) -> LossInputs:
    splats = Splats(
        {
            "means": torch.zeros(2, 3),
            "log_scales": (scale * torch.tensor([[0.1, 0.2, 0.3], [0.5, 0.5, 0.8]])).log(),
            "quats": torch.ones(2, 4),
            "opacity_logits": torch.logit(torch.tensor([[0.2, 0.4], [0.6, 0.8]])),
        }
    )
    return LossInputs(None, None, None, view=None, splats=splats)


def test_opacity_and_size_are_means_over_all():
    assert MeanOpacity()(inputs()).item() == pytest.approx(0.5)
    assert MeanSize()(inputs()).item() == pytest.approx(0.4)


def test_size_counts_in_extents():
    term = MeanSize()
    assert term.prepare(SimpleNamespace(extent=8.0), "thermal") == {}
    assert term(inputs(scale=8.0)).item() == pytest.approx(0.4)
