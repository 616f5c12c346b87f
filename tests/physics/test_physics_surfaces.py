"""What a body radiates beyond the reference, against the powers as they stand."""

import torch

from heatsplat.physics.surfaces import power_excess


def test_the_excess_of_radiation_is_that_of_fourth_powers_and_of_slope_one_at_the_reference():
    excess = torch.linspace(-150.0, 150.0, 31, dtype=torch.float64, requires_grad=True)
    radiated = power_excess(excess, 288.0)
    torch.testing.assert_close(radiated, ((288.0 + excess) ** 4 - 288.0**4) / (4 * 288.0**3), rtol=1e-12, atol=1e-9)
    (slope,) = torch.autograd.grad(radiated.sum(), excess)
    assert slope[15] == 1.0 and bool((slope.diff() > 0).all())
