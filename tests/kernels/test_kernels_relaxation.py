"""Gradients of gains, written out or not. (Values and slopes: tests/physics/test_fused.py.)"""

import numpy as np
import pytest
import torch

from heatsplat.density.ops import Cloud, LongAxisSplit
from heatsplat.kernels import adam
from heatsplat.kernels.relaxation import BLOCK, WORTH_A_SECOND_THREAD
from heatsplat.kernels.scheduling import thread_count, use_threads
from heatsplat.physics.fused import visible_temperature
from heatsplat.splats import Splats
from heatsplat.training.optimisation import OnePassAdam, forget_gradients, load_waiting_gradients, waiting_gradients

DOUBLE = torch.float64


def gains_after(count, frequencies, unwritten, penalty, steps=3):
    """Gains and moments after some steps in which a third of the Gaussians is in view, and the optimiser."""
    generator = torch.Generator().manual_seed(0)
    gains = torch.nn.Parameter(torch.randn(count, 2, frequencies, generator=generator))
    initial, rate = torch.rand(2, count, generator=generator)
    omega = torch.exp(torch.linspace(-2, 5, frequencies, dtype=DOUBLE))
    optimizer = OnePassAdam([{"params": [gains], "lr": 0.01, "weight_decay": 1e-3, "group_penalty": penalty}])
    optimizer.takes_unwritten = unwritten
    for step in range(steps):
        ids = torch.randperm(count, generator=generator)[: -(-count // 3)]
        optimizer.zero_grad()
        time = torch.tensor(0.3 + 2 * step, dtype=DOUBLE)
        values = visible_temperature(time, torch.tensor(0.5), initial, rate, omega, gains, ids=ids)
        values.square().sum().backward()
        assert (gains.grad is None) == unwritten
        optimizer.step()
    return [gains.detach(), *(optimizer.state[gains][name] for name in ("exp_avg", "exp_avg_sq"))], optimizer


@pytest.mark.parametrize("penalty", [0.0, 0.1])
@pytest.mark.parametrize(("count", "frequencies"), [(1, 3), (BLOCK, 16), (3 * BLOCK + 7, 13), (BLOCK + 1, 24)])
def test_a_gradient_that_is_not_written_steps_gains_as_if_it_were(count, frequencies, penalty):
    (found, *moments), optimizer = gains_after(count, frequencies, True, penalty)
    expected, other = gains_after(count, frequencies, False, penalty)
    for mine, theirs in zip((found, *moments), expected, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-5, atol=1e-6)
    assert optimizer.finite() and other.finite()
    assert not hasattr(optimizer.param_groups[0]["params"][0], "unwritten")


def test_squares_summed_in_a_step_are_those_that_are_summed_after_it():
    """So a resumed run, which has to sum them anew, gives the same bits."""
    (gains, *_), optimizer = gains_after(3 * BLOCK + 7, 13, True, 0.1)
    parameter, version, squares = optimizer._squares
    assert version == parameter._version
    again = np.empty_like(squares)
    adam.square_columns(gains.view(-1).numpy(), 13, again)
    np.testing.assert_array_equal(squares, again)


def test_threads_change_no_bit():
    count, before, found = 3 * WORTH_A_SECOND_THREAD + 5, thread_count(), []
    try:
        for threads in (1, 2):
            use_threads(threads)
            found.append(gains_after(count, 13, True, 0.1)[0])
    finally:
        use_threads(before)
    assert all(torch.equal(one, two) for one, two in zip(*found, strict=True))


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
