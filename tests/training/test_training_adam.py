"""Gradients that wait unwritten for a step: of several views, in checkpoints, and where Gaussians come and go."""

import pytest
import torch

from heatsplat.density.ops import Cloud, LongAxisSplit
from heatsplat.kernels.relaxation import BLOCK
from heatsplat.physics.fused import visible_temperature
from heatsplat.splats import Splats
from heatsplat.training.adam import OnePassAdam, forget_gradients, load_waiting_gradients, waiting_gradients

DOUBLE = torch.float64


def waiting_gains(times, count=3 * BLOCK + 7, frequencies=13, unwritten=True):
    """Gains with the gradients of views at some times, a third of the Gaussians in each, before their step; the optimiser."""
    generator = torch.Generator().manual_seed(0)
    gains = torch.nn.Parameter(torch.randn(count, 2, frequencies, generator=generator))
    initial, rate = torch.rand(2, count, generator=generator)
    omega = torch.exp(torch.linspace(-2, 5, frequencies, dtype=DOUBLE))
    optimizer = OnePassAdam([{"params": [gains], "name": "gains", "lr": 0.01}], eps=1e-3)
    optimizer.takes_unwritten = unwritten
    optimizer.zero_grad()
    for time in times:
        ids = torch.randperm(count, generator=generator)[: -(-count // 3)]
        moment = torch.tensor(time, dtype=DOUBLE)
        visible_temperature(moment, torch.tensor(0.5), initial, rate, omega, gains, ids=ids).sum().backward()
    return gains, optimizer


@pytest.mark.parametrize("times", [(0.5, 3.0), (0.0, 1e-3, 0.2, 7.0, 7.0, 40.0, 41.0, 1e4)])
def test_gradients_of_several_moments_in_one_step_add_up(times):
    """Written at once they are what each adds to ``grad``, to the rounding of a sum; and so is the step with them."""
    found = []
    for unwritten in (True, False):
        gains, optimizer = waiting_gains(times, unwritten=unwritten)
        before = gains.detach().clone()
        gradient = gains.unwritten.written(gains.shape).clone() if unwritten else gains.grad.clone()
        optimizer.step()
        assert not torch.equal(gains, before)
        found.append((gradient, gains.detach(), optimizer.state[gains]["exp_avg"]))
    for mine, theirs in zip(*found, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-6)


def test_gradients_that_wait_in_a_checkpoint_give_the_same_bits():
    times = (0.3, 2.0, 5.0)
    gains, optimizer = waiting_gains(times)
    holder = torch.nn.ParameterDict({"gains": gains})
    state = waiting_gradients(holder)
    assert not state["gradients"] and state["unwritten"]["gains"]["times"].tolist() == pytest.approx(times)
    other = torch.nn.ParameterDict({"gains": gains.detach().clone()})
    load_waiting_gradients(other, state)
    optimizer.step()
    OnePassAdam([{"params": list(other.values()), "lr": 0.01}], eps=1e-3).step()
    assert torch.equal(gains, other["gains"])


def test_gradients_that_wait_come_back_written_where_the_kernel_does_not_step():
    gains, _ = waiting_gains((0.3, 2.0))
    other = torch.nn.ParameterDict({"gains": gains.detach().double()})
    load_waiting_gradients(other, waiting_gradients(torch.nn.ParameterDict({"gains": gains})))
    torch.testing.assert_close(other["gains"].grad, gains.unwritten.written(gains.shape).double())


def test_forgotten_gradients_step_nothing():
    gains, optimizer = waiting_gains((0.3, 2.0))
    before = gains.detach().clone()
    forget_gradients(gains)
    optimizer.step()
    assert torch.equal(gains, before)


def test_gradients_that_wait_follow_rows_that_come_and_go():
    """As a gradient that is written follows them."""
    found = []
    for unwritten in (True, False):
        gains, optimizer = waiting_gains((0.3, 2.0), count=40, unwritten=unwritten)
        others = [("means", torch.zeros(40, 3)), ("log_scales", torch.zeros(40, 3)), ("quats", torch.ones(40, 4))]
        splats = Splats(dict(others) | {"opacity_logits": torch.zeros(40, 1), "gains": gains.detach()})
        splats.raw["gains"] = gains
        cloud = Cloud(splats, optimizer, {})
        cloud.keep(torch.arange(40) % 3 > 0)
        cloud.append(cloud.rows(torch.tensor([1, 5, 7])))
        cloud.split(torch.tensor([2, 3]), LongAxisSplit())
        (left,) = optimizer.param_groups[0]["params"]
        assert left.shape == (31, 2, 13) and (left.grad is None) == unwritten
        optimizer.step()
        found.append(left.detach())
    torch.testing.assert_close(*found, rtol=1e-5, atol=1e-6)
