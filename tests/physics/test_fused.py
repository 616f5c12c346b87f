"""The fused kernel, in float32 and float64, against its plain twin and 200 digits, on any K, rows, threads and moment."""

import math

import numba
import pytest
import torch
from harmonic_reference import draw, exact, joint_error

from heatsplat.kernels import relaxation as kernels
from heatsplat.physics import fused
from heatsplat.physics.fused import visible_temperature

DOUBLE = torch.float64
KINDS = {torch.float32: 1e-6, DOUBLE: 2e-15}  # errors allowed


def case(count, frequencies, seed=0, scaled=False, span=2.0):
    """Leaves ambient, initial, rate, gains, scale (or None), and omega: rates on both sides of y = 1 at time 1."""
    generator = torch.Generator().manual_seed(seed)
    leaves = {
        "ambient": torch.tensor(0.3),
        "initial": torch.rand(count, generator=generator),
        "rate": torch.exp(span * torch.randn(count, generator=generator)),
        "gains": torch.randn(count, 2, frequencies, generator=generator),
        "inverse_capacity": torch.rand(count, generator=generator) + 0.5 if scaled else None,
    }
    omega = torch.exp(torch.linspace(-2, 5, frequencies, dtype=DOUBLE))
    return {k: None if v is None else v.requires_grad_() for k, v in leaves.items()}, omega


def run(function, leaves, omega, time, ids, weights, dtype):
    """Values and gradients of the weighted sum, with leaves copied to ``dtype``."""
    copies = {k: None if v is None else v.detach().to(dtype).requires_grad_() for k, v in leaves.items()}
    values = function(torch.tensor(time, dtype=DOUBLE), omega=omega, ids=ids, **copies)
    (values * weights.to(dtype)).sum().backward()
    return values.detach(), {k: v.grad for k, v in copies.items() if v is not None and v.numel() > 0}


def twin(time, ambient, initial, rate, gains, omega, inverse_capacity=None, ids=None):
    """The plain form, called as ``visible_temperature`` is."""
    return fused._reference(time, ambient, initial, rate, omega, gains, inverse_capacity, ids, None)


@pytest.mark.parametrize("dtype", KINDS, ids=str)
@pytest.mark.parametrize("frequencies", [0, 1, 2, 15, 16, 17, 24, 32, 40])
@pytest.mark.parametrize("time", [0.0, 1e-4, 1.0, 30.0, -0.5])
def test_kernel_equals_the_twin(frequencies, time, dtype):
    leaves, omega = case(300, frequencies, scaled=frequencies in (2, 16, 24))
    weights, error = torch.linspace(-1, 2, 300), KINDS[dtype]
    values, gradients = run(visible_temperature, leaves, omega, time, None, weights, dtype)
    expected, truth = run(twin, leaves, omega, time, None, weights, DOUBLE)
    assert fused._fits_kernel(leaves["rate"], omega) and values.dtype == dtype
    torch.testing.assert_close(values.double(), expected, rtol=error, atol=error * (1 + expected.abs().max().item()))
    # Terms of the sum over all Gaussians have both signs: they cancel, what they are rounded by does not.
    summed = run(twin, leaves, omega, time, None, weights.abs(), DOUBLE)[1]["ambient"]
    for name, gradient in gradients.items():
        scale = (summed if name == "ambient" else truth[name]).abs().max().item()
        torch.testing.assert_close(gradient.double(), truth[name], rtol=2 * error, atol=error * scale, msg=name)


@pytest.mark.parametrize("fall", [80.0, 87.4, 90.2, 103.0, 1e3, 1e13])
def test_a_body_that_has_long_forgotten_its_start(fall):
    """e^-fall leaves the normal numbers of float32 at 87.3, and all of them at 103.3."""
    leaves, omega = case(40, 24)
    leaves["rate"] = torch.full((40,), fall).requires_grad_()
    weights = torch.ones(40)
    values, gradients = run(visible_temperature, leaves, omega, 1.0, None, weights, torch.float32)
    expected, truth = run(twin, leaves, omega, 1.0, None, weights, DOUBLE)
    torch.testing.assert_close(values.double(), expected, rtol=1e-6, atol=1e-6)
    for name, gradient in gradients.items():
        scale = truth[name].abs().max().item()
        torch.testing.assert_close(gradient.double(), truth[name], rtol=1e-5, atol=1e-6 * scale + 1e-30, msg=name)


@pytest.mark.parametrize("count", [1, 15, 255, 256, 257, 1000])
def test_only_rows_in_view_are_read_and_written(count):
    leaves, omega = case(count, 24)
    ids = torch.randperm(count, generator=torch.Generator().manual_seed(1))[: (count + 1) // 2]
    unseen = torch.ones(count, dtype=torch.bool).index_fill(0, ids, False)
    weights = torch.ones(len(ids))
    expected, truth = run(twin, leaves, omega, 0.8, ids, weights, DOUBLE)
    with torch.no_grad():
        for name in ("initial", "rate", "gains"):
            leaves[name][unseen] = torch.nan
    values, gradients = run(visible_temperature, leaves, omega, 0.8, ids, weights, torch.float32)
    torch.testing.assert_close(values.double(), expected, rtol=1e-6, atol=2e-6)
    for name in ("initial", "rate", "gains"):
        assert not gradients[name][unseen].any(), name
        torch.testing.assert_close(gradients[name][ids].double(), truth[name][ids], rtol=2e-6, atol=2e-6, msg=name)


def test_no_rows_in_view():
    leaves, omega = case(10, 24)
    values, gradients = run(
        visible_temperature, leaves, omega, 1.0, torch.zeros(0, dtype=torch.int64), torch.ones(0), torch.float32
    )
    assert values.shape == (0,)
    assert all(not gradient.any() for gradient in gradients.values())


def test_one_and_two_threads_and_reruns_give_the_same_bits():
    leaves, omega = case(30_000, 24, scaled=True)
    ids = torch.arange(0, 30_000, 3)  # enough for a second thread
    assert len(ids) >= kernels.WORTH_A_SECOND_THREAD
    weights, before = torch.linspace(-1, 1, len(ids)), numba.get_num_threads()
    try:
        results = []
        for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS), 1):
            numba.set_num_threads(threads)
            results.append(run(visible_temperature, leaves, omega, 0.7, ids, weights, torch.float32))
    finally:
        numba.set_num_threads(before)
    for values, gradients in results[1:]:
        assert torch.equal(values, results[0][0])
        assert all(torch.equal(gradients[name], results[0][1][name]) for name in gradients)


@pytest.mark.parametrize(("dtype", "error"), [(torch.float32, 6e-7), (DOUBLE, 1e-15)], ids=str)
def test_responses_over_the_whole_range_against_many_digits(dtype, error):
    """The ranges of the plain form: gains of one sixteen-lane row pick single responses, gradients pick slopes."""
    worst = 0.0
    rates, omegas, times = (x[:400] for x in draw(400, seed=3))
    for rate, omega, time in zip(rates.tolist(), omegas.tolist(), times.tolist(), strict=True):
        reference = exact(rate, omega, time)
        gains = torch.zeros(2, 2, 1, dtype=dtype)
        gains[0, 0], gains[1, 1] = 1, 1
        a = torch.full((2,), rate, dtype=dtype).requires_grad_()
        still, none = torch.zeros(2, dtype=dtype), torch.zeros((), dtype=dtype)
        values = visible_temperature(
            torch.tensor(time, dtype=DOUBLE), none, still, a, torch.tensor([omega], dtype=DOUBLE), gains
        )
        values.sum().backward()
        worst = max(worst, joint_error(values.tolist(), reference[:2]), joint_error(a.grad.tolist(), reference[2:]))
    assert worst <= error


@pytest.mark.parametrize("dtype", KINDS, ids=str)
@pytest.mark.parametrize("rate", [0.0, 1e-45, 1e-30, 1e18, 1e30, math.inf])
@pytest.mark.parametrize("time", [-3.0, 0.0, 1e-3, 50.0])
def test_extreme_rates_are_finite(rate, time, dtype):
    leaves, omega = case(20, 24)
    leaves["rate"].data.fill_(rate)
    values, gradients = run(visible_temperature, leaves, omega, time, None, torch.ones(20), dtype)
    assert values.isfinite().all()
    assert all(gradient.isfinite().all() for gradient in gradients.values())
    if time == 0:
        assert torch.equal(values, leaves["initial"].to(dtype))


def test_a_frequency_of_zero_takes_the_plain_path():
    leaves, _ = case(5, 2)
    omega = torch.tensor([0.0, 1.0], dtype=DOUBLE)
    assert not fused._fits_kernel(leaves["rate"], omega)
    leaves["rate"].data.fill_(1e-30)
    values, gradients = run(visible_temperature, leaves, omega, 2.0, None, torch.ones(5), torch.float32)
    assert gradients["gains"][:, 1, 0].tolist() == [2.0] * 5  # a constant source of an insulated body: its time
    assert values.isfinite().all()


def test_gains_of_another_shape_are_refused():
    leaves, omega = case(5, 3)
    with pytest.raises(ValueError, match=r"gains must have shape \[5, 2, 2\], got \[5, 2, 3\]"):
        run(visible_temperature, leaves, omega[:2], 1.0, None, torch.ones(5), torch.float32)


def test_changing_an_input_before_the_backward_pass_is_noticed():
    leaves, omega = case(5, 3)
    values = visible_temperature(torch.tensor(1.0, dtype=DOUBLE), omega=omega, **leaves)
    leaves["gains"].data = leaves["gains"].data.clone()
    with torch.no_grad():
        leaves["rate"].mul_(2)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        values.sum().backward()


def test_gradients_of_two_moments_add_up():
    """Memory of gradients is reused, never while somebody still holds it: within a graph, between two, and after."""
    leaves, omega = case(50, 24)
    del leaves["inverse_capacity"]
    gains = leaves["gains"]

    def at(time):
        return visible_temperature(torch.tensor(time, dtype=DOUBLE), omega=omega, **leaves).sum()

    single = []
    for time in (0.3, 2.0):
        at(time).backward()
        single.append(gains.grad.clone())
        gains.grad = None
    (at(0.3) + at(2.0)).backward()
    torch.testing.assert_close(gains.grad, single[0] + single[1])
    at(0.3).backward()
    torch.testing.assert_close(gains.grad, 2 * single[0] + single[1])
    kept = gains.grad
    gains.grad = None
    at(2.0).backward()
    assert torch.equal(gains.grad, single[1])
    torch.testing.assert_close(kept, 2 * single[0] + single[1])


def test_memory_of_gradients_is_used_again():
    leaves, omega = case(50, 24)
    where = set()
    for _ in range(3):
        leaves["gains"].grad = None
        visible_temperature(torch.tensor(1.0, dtype=DOUBLE), omega=omega, **leaves).sum().backward()
        where.add(leaves["gains"].grad.data_ptr())
    assert len(where) == 1
    assert where.pop() % 64 == 0
