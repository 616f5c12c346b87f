"""Rows read one after the other: where they are displaced to, gradients, and what is refused."""

import pytest
import torch
from swinging import HEIGHT, WIDTH, frames, ready, wall

from heatsplat.sensors.rolling_readout import RollingReadout


def test_the_middle_stands_still_and_the_ends_are_displaced_opposite_ways():
    part = ready(RollingReadout(), raw_readout=0.4)
    ramp = torch.arange(WIDTH, dtype=torch.float64).expand(HEIGHT, WIDTH)[..., None]
    depth = torch.full((HEIGHT, WIDTH), 2.0, dtype=torch.float64)
    moved = (part(ramp, frames()[2], depth) - ramp)[:, 6:-6, 0]
    across = part.velocity(frames()[2], depth)[:, 6:-6, 0]
    delays = ((torch.arange(HEIGHT) + 0.5) / HEIGHT - 0.5)[:, None] * part.readout()
    assert torch.allclose(moved, -across * delays, atol=1e-9) and moved.abs().max() > 0.1


def test_gradients_are_those_of_finite_differences():
    image = wall(0.05)[0][:, :, None].clone().requires_grad_()
    part, raw = ready(RollingReadout()), torch.tensor(0.3, dtype=torch.float64, requires_grad=True)

    def made(image, readout):
        return torch.func.functional_call(part, {"raw_readout": readout}, (image, frames()[2], wall(0.05)[1])).mean(
            (0, 2)
        )

    assert torch.autograd.gradcheck(made, (image, raw), eps=1e-7, atol=1e-5, fast_mode=True)


def test_a_bound_of_nothing_is_refused():
    with pytest.raises(ValueError, match="readout_max is a time in seconds"):
        RollingReadout(readout_max=0)
