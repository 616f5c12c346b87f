"""Adam in one pass against torch's in float64, and the same bits on any number of threads."""

import copy
import math

import pytest
import torch

from heatsplat.kernels import adam
from heatsplat.kernels.scheduling import thread_count, use_threads
from heatsplat.training.adam import OnePassAdam
from heatsplat.training.rng import generator_for

SHAPES = ((), (5,), (16, 3), (700, 2, 24), (adam.SHARE + 1,), (0, 3))
DECAYS = (0.0, 0.1, 0.0, 1e-3, 0.0, 0.0)


def groups(dtype: torch.dtype) -> list[dict]:
    generator = generator_for(0, 0, "adam")
    return [
        {"params": [torch.nn.Parameter(torch.randn(shape, generator=generator).to(dtype))], "lr": 0.01 * (1 + row)}
        | {"weight_decay": decay}
        for row, (shape, decay) in enumerate(zip(SHAPES, DECAYS, strict=True))
    ]


def trained(optimizer: torch.optim.Adam, steps: range) -> list[torch.Tensor]:
    """Parameters after some steps; every third gradient of a tensor is missing, and a third of its numbers are zero."""
    for step in steps:
        generator = generator_for(1, step, "adam")
        for row, group in enumerate(optimizer.param_groups):
            (parameter,) = group["params"]
            gradient = torch.randn(parameter.shape, generator=generator)
            gradient *= torch.rand(parameter.shape, generator=generator) > 0.3
            parameter.grad = None if (step + row) % 3 == 2 else gradient.to(parameter)
        optimizer.step()
    return [group["params"][0].detach() for group in optimizer.param_groups]


def test_it_is_torchs_adam():
    mine, theirs = OnePassAdam(groups(torch.float32), eps=1e-15), torch.optim.Adam(groups(torch.float64), eps=1e-15)
    for x, y in zip(trained(mine, range(12)), trained(theirs, range(12)), strict=True):
        torch.testing.assert_close(x.double(), y, rtol=1e-5, atol=5e-6)
    for group, other in zip(mine.param_groups, theirs.param_groups, strict=True):
        state, expected = mine.state[group["params"][0]], theirs.state[other["params"][0]]
        assert state["step"] == expected["step"] == 8
        for moment in ("exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(state[moment].double(), expected[moment], rtol=1e-5, atol=1e-7)


def test_it_goes_on_from_what_torchs_left():
    theirs = torch.optim.Adam(groups(torch.float32), eps=1e-15, fused=True)
    trained(theirs, range(5))
    mine = OnePassAdam(groups(torch.float32), eps=1e-15, fused=True)
    mine.load_state_dict(copy.deepcopy(theirs.state_dict()))  # torch would share the moments
    with torch.no_grad():
        for group, other in zip(mine.param_groups, theirs.param_groups, strict=True):
            group["params"][0].copy_(other["params"][0])
    for x, y in zip(trained(mine, range(5, 9)), trained(theirs, range(5, 9)), strict=True):
        torch.testing.assert_close(x, y, rtol=1e-5, atol=5e-6)


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_change_no_bit(threads):
    before = thread_count()
    results = []
    try:
        for count in (1, threads):
            use_threads(count)
            results.append(trained(OnePassAdam(groups(torch.float32)), range(4)))
    finally:
        use_threads(before)
    assert all(torch.equal(x, y) for x, y in zip(*results, strict=True))


@pytest.mark.parametrize(("dtype", "close"), [(torch.float32, 5e-6), (torch.float64, 1e-12)])
@pytest.mark.parametrize("shape", [(700, 2, 24), (3, 5), (9000, 1), (2, 16)])
def test_the_penalty_of_groups_is_that_of_their_norms(shape, dtype, close):
    generator, weight = generator_for(0, 0, "groups"), 0.3
    start, pulls = torch.randn(2, *shape, generator=generator, dtype=torch.float64)
    start[..., 0] = 0  # a group that is nothing pulls nowhere
    inside, outside = (torch.nn.Parameter(start.to(kind)) for kind in (dtype, torch.float64))
    mine = OnePassAdam([{"params": [inside], "lr": 0.01, "weight_decay": 0.1, "group_penalty": weight}])
    theirs = torch.optim.Adam([outside], lr=0.01, weight_decay=0.1)
    for step in range(4):
        inside.grad = (pulls * (step + 1)).to(dtype)
        theirs.zero_grad()
        norms = torch.linalg.vector_norm(outside.flatten(0, -2), dim=0)
        (weight * norms.sum() + (outside * pulls).sum() * (step + 1)).backward()
        mine.step()
        theirs.step()
    torch.testing.assert_close(inside.detach().double(), outside.detach(), rtol=0, atol=close)


@pytest.mark.parametrize("broken", [math.nan, math.inf])
def test_it_tells_whether_what_it_wrote_is_finite(broken):
    optimizer = OnePassAdam(groups(torch.float32))
    assert optimizer.finite() is None
    trained(optimizer, range(1))
    assert optimizer.finite()
    with torch.no_grad():
        optimizer.param_groups[3]["params"][0][-1, -1, -1] = broken
    trained(optimizer, range(1, 2))
    assert not optimizer.finite()


def test_what_the_kernel_cannot_take_is_stepped_by_torch():
    mine, theirs = OnePassAdam(groups(torch.float64)), torch.optim.Adam(groups(torch.float64))
    for x, y in zip(trained(mine, range(4)), trained(theirs, range(4)), strict=True):
        assert torch.equal(x, y)
