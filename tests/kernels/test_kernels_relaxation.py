"""Gradients of gains, written out or not. (Values and slopes: tests/physics/test_fused.py.)"""

import numpy as np
import pytest
import torch

from heatsplat.kernels import adam
from heatsplat.kernels.relaxation import BLOCK, WORTH_A_SECOND_THREAD
from heatsplat.kernels.scheduling import thread_count, use_threads
from heatsplat.physics.fused import visible_temperature
from heatsplat.training.adam import OnePassAdam

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
