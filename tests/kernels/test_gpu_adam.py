"""Adam by Triton's kernel against torch's in float64: moments, decay, penalties of groups, and what comes and goes."""

import pytest
import torch
from triton_device import DEVICE

pytest.importorskip("triton", reason="compares Triton's kernel with torch's optimiser")

from heatsplat.kernels.gpu import adam
from heatsplat.training.adam import OnePassAdam

SHAPES = ((), (5,), (700, 2, 24), (adam.BLOCK + 1,), (0, 3), (3, 7))
DECAYS = (0.0, 0.1, 1e-3, 0.0, 0.0, 0.2)


def groups(dtype, device):
    generator = torch.Generator().manual_seed(0)
    starts = [torch.randn(shape, generator=generator, dtype=torch.float64) for shape in SHAPES]
    starts[2][..., 3] = 0  # a column that is nothing pulls nowhere
    return [
        {"params": [torch.nn.Parameter(start.to(device, dtype))], "lr": 0.01 * (1 + row), "weight_decay": decay}
        | ({"group_penalty": 0.3} if start.ndim == 3 else {})
        for row, (start, decay) in enumerate(zip(starts, DECAYS, strict=True))
    ]


def trained(optimizer, steps, step):
    """Steps of gradients, of which every third of a tensor is missing and one lies across memory."""
    for k in steps:
        generator = torch.Generator().manual_seed(k)
        for row, group in enumerate(optimizer.param_groups):
            (parameter,) = group["params"]
            gradient = torch.randn(parameter.shape, generator=generator)
            gradient *= torch.rand(parameter.shape, generator=generator) > 0.3
            gradient = gradient.to(parameter)
            if parameter.ndim == 2:
                gradient = gradient.T.contiguous().T
            parameter.grad = None if (k + row) % 3 == 2 else gradient
        step(optimizer)
    return [group["params"][0].detach().cpu().double() for group in optimizer.param_groups]


def in_kernel(optimizer):
    pairs = [(group, x) for group in optimizer.param_groups for x in group["params"] if x.grad is not None]
    with torch.no_grad():
        optimizer._step_on_cuda(pairs)


def test_it_is_torchs_adam():
    mine, theirs = OnePassAdam(groups(torch.float32, DEVICE)), OnePassAdam(groups(torch.float64, "cpu"))
    found, expected = trained(mine, range(12), in_kernel), trained(theirs, range(12), OnePassAdam.step)
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-5, atol=5e-6)
    for group, other in zip(mine.param_groups, theirs.param_groups, strict=True):
        state, truth = mine.state[group["params"][0]], theirs.state[other["params"][0]]
        assert state["step"] == truth["step"] == 8
        for moment in ("exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(state[moment].cpu().double(), truth[moment], rtol=1e-5, atol=1e-7)


def test_rows_that_come_between_steps_are_stepped():
    mine, theirs = OnePassAdam(groups(torch.float32, DEVICE)), OnePassAdam(groups(torch.float64, "cpu"))
    for optimizer, step in ((mine, in_kernel), (theirs, OnePassAdam.step)):
        trained(optimizer, range(3), step)
        for group in optimizer.param_groups[1:3]:
            (old,) = group["params"]
            state = optimizer.state.pop(old)
            new = torch.nn.Parameter(torch.cat([old.detach(), old.detach()]))
            optimizer.state[new] = state | {name: torch.cat([state[name]] * 2) for name in ("exp_avg", "exp_avg_sq")}
            group["params"] = [new]
    found, expected = trained(mine, range(3, 6), in_kernel), trained(theirs, range(3, 6), OnePassAdam.step)
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-5, atol=5e-6)


@pytest.mark.gpu
def test_cuda_is_stepped_by_it_and_goes_on_from_a_checkpoint():
    if DEVICE != "cuda":
        pytest.skip("needs CUDA")
    mine, theirs = OnePassAdam(groups(torch.float32, DEVICE), fused=True), OnePassAdam(groups(torch.float64, "cpu"))
    trained(mine, range(4), OnePassAdam.step)
    resumed = OnePassAdam([group | {"params": list(group["params"])} for group in mine.param_groups], fused=True)
    resumed.load_state_dict(mine.state_dict())
    found, expected = trained(resumed, range(4, 8), OnePassAdam.step), trained(theirs, range(8), OnePassAdam.step)
    for x, y in zip(found, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-5, atol=5e-6)
    assert all(not state["step"].is_cuda for state in resumed.state.values())
