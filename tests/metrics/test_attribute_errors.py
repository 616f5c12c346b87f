"""Errors of material attributes: names, weights, and what nobody knows."""

import pytest
import torch

from heatsplat.metrics.attribute_errors import attribute_errors

TRUTH = {
    "emissivity": torch.tensor([0.9, 0.8]),
    "heat_capacity_j_m3_k": torch.tensor([2e6, 1e6]),
    "depth_m": torch.ones(2),
}


def test_errors_are_means_in_the_unit_of_each():
    told = {"emissivity": torch.tensor([0.8, 0.8]), "capacity": torch.tensor([2e6, 4e6]), "latent": torch.zeros(2)}
    errors = attribute_errors(told, TRUTH)
    assert errors == {"emissivity": pytest.approx(0.05), "capacity": pytest.approx(1.5e6)}


def test_weights_and_unknown_values():
    told = {"emissivity": torch.tensor([0.8, 0.5])}
    assert attribute_errors(told, TRUTH, torch.tensor([3.0, 1.0]))["emissivity"] == pytest.approx(0.15)
    assert attribute_errors({"emissivity": torch.tensor([torch.nan, 0.5])}, TRUTH)["emissivity"] == pytest.approx(0.3)
    assert attribute_errors({"emissivity": torch.full((2,), torch.nan)}, TRUTH) == {}
