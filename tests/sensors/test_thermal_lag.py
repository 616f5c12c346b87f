"""The lag of pixels: weights of the past, gradients, and what is refused."""

import math

import pytest
import torch
from swinging import frames, ready, wall

from heatsplat.sensors.thermal_lag import ThermalLag, moments


def test_ages_and_weights_integrate_lines_exactly():
    for count in (2, 4, 33):
        ages, weights = moments(count)
        assert weights.min() >= 0 and weights.sum().item() == pytest.approx(1, abs=1e-14)
        assert (weights * ages).sum().item() == pytest.approx(1 - math.exp(-6.0), abs=1e-12)


def test_gradients_are_those_of_finite_differences():
    image = wall(0.05)[0][:, :, None].clone().requires_grad_()
    part, raw = ready(ThermalLag()), [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.2, 0.1)]

    def made(image, tau, lead):
        given = {"raw_tau": tau, "raw_lead": lead}
        return torch.func.functional_call(part, given, (image, frames()[2], wall(0.05)[1])).mean((0, 2))

    assert torch.autograd.gradcheck(made, (image, *raw), eps=1e-7, atol=1e-5, fast_mode=True)


def test_the_time_constant_is_bounded_and_a_lead_may_be_left_out():
    part = ready(ThermalLag(), raw_tau=-0.5)
    assert part.tau().item() == 0.0
    part.tau().backward()
    assert part.raw_tau.grad > 0  # it can come back
    assert ready(ThermalLag(), raw_tau=50.0).tau().item() == pytest.approx(0.05)
    bare = ready(ThermalLag(lead_max=0.0), raw_tau=0.3)
    assert [name for name, _ in bare.named_parameters()] == ["raw_tau"]
    assert bare.penalty().item() == pytest.approx(math.tanh(0.3) ** 2)
    with pytest.raises(ValueError, match="tau_max must be positive"):
        ThermalLag(tau_max=0)
