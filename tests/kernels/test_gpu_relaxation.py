"""Temperatures by Triton's kernels against plain torch in float64."""

import pytest
import torch
from triton_device import DEVICE

pytest.importorskip("triton", reason="compares Triton's kernels with plain torch")

from heatsplat.kernels import gpu
from heatsplat.physics import fused

DOUBLE = torch.float64
COUNT = 150


def heat(frequencies, bounded, scaled, placed):
    """Leaves (float64), and omega, ids and places of COUNT Gaussians; rates on both sides of y = 1 at time 1."""
    generator = torch.Generator().manual_seed(frequencies)

    def draw(*shape):
        return torch.randn(*shape, generator=generator, dtype=DOUBLE)

    places, rows = None, COUNT
    if placed:
        heated = torch.rand(COUNT, generator=generator) < 0.6
        places = torch.where(heated, heated.cumsum(0) - 1, -1)
        rows = int(heated.sum())
    leaves = {
        "ambient": torch.tensor(0.3, dtype=DOUBLE),
        "initial": draw(COUNT).sigmoid(),
        "rate": 2 * draw(COUNT) if bounded else (2 * draw(COUNT)).exp(),
        "gains": draw(rows, 2, frequencies) if frequencies else None,
        "inverse_capacity": draw(COUNT).sigmoid() + 0.5 if scaled else None,
    }
    omega = torch.linspace(-2, 5, frequencies, dtype=DOUBLE).exp()
    return leaves, omega, torch.randperm(COUNT, generator=generator)[: COUNT - 30], places


def evaluated(function, dtype, device, leaves, time, omega, ids, places, log_bounds):
    leaves = {name: None if x is None else x.to(device, dtype).requires_grad_() for name, x in leaves.items()}
    values = function(
        torch.tensor(time, dtype=DOUBLE), omega=omega, ids=ids.to(device), log_bounds=log_bounds,
        places=None if places is None else places.to(device), **leaves,
    )  # fmt: skip
    (values * torch.linspace(-1, 2, len(ids), device=device, dtype=dtype)).sum().backward()
    return values.detach().cpu().double(), {n: x.grad.cpu().double() for n, x in leaves.items() if x is not None}


def plain(time, ambient, initial, rate, gains, omega, inverse_capacity, ids, places, log_bounds):
    rate = rate if log_bounds is None else rate.clamp(*log_bounds).exp()
    return fused._reference(time, ambient, initial, rate, omega, gains, inverse_capacity, ids, places)


def in_kernel(time, ambient, initial, rate, gains, omega, inverse_capacity, ids, places, log_bounds):
    return fused._VisibleTemperatureOnCuda.apply(
        time, ambient, initial, rate, omega, gains, inverse_capacity, ids, places, log_bounds
    )


@pytest.mark.parametrize("options", ["", "bounded", "scaled", "placed", "bounded scaled placed"])
@pytest.mark.parametrize("frequencies", [0, 1, 16, 24, 33])
@pytest.mark.parametrize("time", [0.0, 1e-4, 1.0, 30.0, -0.5])
def test_temperatures_and_gradients(time, frequencies, options):
    has = {name: name in options for name in ("bounded", "scaled", "placed")}
    if frequencies == 0 and options not in ("", "bounded"):
        pytest.skip("without frequencies there is nothing to scale or to place")
    leaves, omega, ids, places = heat(frequencies, **has)
    rest = (leaves, time, omega, ids, places, (-3.0, 2.0) if has["bounded"] else None)
    values, gradients = evaluated(in_kernel, torch.float32, DEVICE, *rest)
    expected, truth = evaluated(plain, DOUBLE, "cpu", *rest)
    torch.testing.assert_close(values, expected, rtol=1e-6, atol=1e-6 * (1 + expected.abs().max().item()))
    for name, gradient in gradients.items():
        torch.testing.assert_close(
            gradient, truth[name], rtol=3e-6, atol=2e-6 * truth[name].abs().max().item(), msg=name
        )


@pytest.mark.parametrize("rate", [0.0, 1e-30, 1e18, float("inf")])
@pytest.mark.parametrize("time", [-3.0, 0.0, 1e-3, 50.0])
def test_extreme_rates_are_finite(rate, time):
    leaves, omega, ids, places = heat(16, False, False, False)
    leaves["rate"] = torch.full((COUNT,), rate, dtype=DOUBLE)
    values, gradients = evaluated(in_kernel, torch.float32, DEVICE, leaves, time, omega, ids, places, None)
    assert values.isfinite().all() and all(gradient.isfinite().all() for gradient in gradients.values())


def test_rows_out_of_view_get_no_gradient_and_none_in_view_is_fine():
    leaves, omega, ids, _ = heat(16, False, True, False)
    _, gradients = evaluated(in_kernel, torch.float32, DEVICE, leaves, 1.0, omega, ids, None, None)
    hidden = torch.ones(COUNT, dtype=torch.bool).index_fill(0, ids, False)
    assert all((gradients[name][hidden] == 0).all() for name in ("initial", "rate", "gains", "inverse_capacity"))
    values, gradients = evaluated(in_kernel, torch.float32, DEVICE, leaves, 1.0, omega, ids[:0], None, None)
    assert len(values) == 0 and (gradients["gains"] == 0).all()


def test_without_a_compiler_plain_torch_does_it(monkeypatch):
    gpu.available.cache_clear()
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setattr("shutil.which", lambda name: None)
    assert not gpu.available()
    gpu.available.cache_clear()
