"""Closed form and frequency grid over their whole ranges: error bounds, exact limits, gradients."""

import math

import mpmath
import pytest
import torch
from draws import logarithmic
from hypothesis import example, given, settings
from hypothesis import strategies as st
from physics.harmonic_reference import exact, joint_error, own_error
from physics.planck_reference import band_radiance, band_slope

from heatsplat.physics.energy_balance import Climate
from heatsplat.physics.frequencies import LOWEST_HZ, NARROWEST_BAND, frequency_grid
from heatsplat.physics.fused import SMALLEST_OMEGA, visible_temperature
from heatsplat.physics.marching import stepped_temperature
from heatsplat.physics.planck import Band
from heatsplat.physics.relaxation import harmonic_response, relax, response_slope, temperature
from heatsplat.physics.responses import step_weights
from heatsplat.physics.surfaces import Drivers, Surface, power_excess

rates = logarithmic(1e-12, 1e4, 0.0, 1e-45, 1e-30, 1e-20, 1e9)
omegas = logarithmic(1e-5, 3e2, 0.0, 1e-30, 1e-12)
times = logarithmic(1e-3, 1e5, 0.0, 1e-8)

# Errors over |S| + |C|, and over the kernel's own value. Outside the range of the table (rates below 1e-12 and above
# 1e4) the bounds are the same.
JOINT = {torch.float32: 5e-7, torch.float64: 2e-15}
OWN = {torch.float32: 1e-4, torch.float64: 1e-12}


def double(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("dtype", JOINT, ids=str)
@settings(max_examples=250)
@given(rates, omegas, times)
@example(1.0, 1e-12, 1.0)
@example(1e4, 1e-5, 1e5)
def test_responses_and_slopes_keep_their_digits(dtype, rate, omega, time):
    a, w, t = double(rate).to(dtype), double(omega), torch.tensor(time, dtype=torch.float64)
    values = [x.item() for x in harmonic_response(a, w, t)]
    slopes = [x.item() for x in response_slope(a, w, t)]
    assert all(map(math.isfinite, values + slopes))
    if time == 0:
        assert values == slopes == [0, 0]
    elif rate == 0 and omega == 0:
        assert values[0] == slopes[0] == 0
        assert values[1] == t.to(dtype).item()
        assert slopes[1] == pytest.approx(-(time**2) / 2, rel=2 * torch.finfo(dtype).eps)
    else:
        truth = exact(rate, omega, time)
        assert joint_error(values, truth[:2]) <= JOINT[dtype]
        if min(map(abs, truth[:2])) > torch.finfo(dtype).tiny:
            assert own_error(values, truth[:2], omega * time) <= OWN[dtype]
        # The slope by a decade-wide rate is what the optimiser sees (it learns log a); it must keep its digits as well.
        assert joint_error(slopes, truth[2:]) <= 2 * JOINT[dtype]


@settings(max_examples=150)
@given(omegas, times)
def test_without_decay_the_responses_are_those_of_an_integral(omega, time):
    sine, cosine = (x.item() for x in harmonic_response(double(0.0), double(omega), double(time)[0]))
    with mpmath.workdps(60):
        x = mpmath.mpf(omega) * mpmath.mpf(time)
        expected = (0, mpmath.mpf(time)) if omega == 0 else (2 * mpmath.sin(x / 2) ** 2 / omega, mpmath.sin(x) / omega)
        assert abs(sine - expected[0]) + abs(cosine - expected[1]) <= 4e-16 * sum(map(abs, expected))


@settings(max_examples=150)
@given(rates, times)
def test_without_frequency_the_response_is_that_to_a_constant(rate, time):
    sine, cosine = (x.item() for x in harmonic_response(double(rate), double(0.0), double(time)[0]))
    assert sine == 0
    assert cosine == pytest.approx(-math.expm1(-rate * time) / rate if rate > 1e-300 else time, rel=1e-15)


@settings(max_examples=100)
@given(logarithmic(1e-12, 1e4, 0.0, 1e-45, 1e-30), logarithmic(1e-5, 3e2), logarithmic(1e-3, 1e5), st.booleans())
def test_the_fused_kernel_keeps_its_digits(rate, omega, time, scaled):
    assert omega >= SMALLEST_OMEGA
    gains = torch.eye(2)[:, :, None].contiguous()
    a, still = torch.full((2,), rate).requires_grad_(), torch.zeros(2)
    scale = torch.ones(2) if scaled else None
    moment = torch.tensor(time, dtype=torch.float64)
    values = visible_temperature(moment, torch.tensor(0.0), still, a, double(omega), gains, scale)
    values.sum().backward()
    truth = exact(rate, omega, time)
    assert joint_error(values.tolist(), truth[:2]) <= 6e-7
    assert own_error(values.tolist(), truth[:2], omega * time) <= OWN[torch.float32]
    assert joint_error(a.grad.tolist(), truth[2:]) <= 1.2e-6


@pytest.mark.parametrize("dtype", JOINT, ids=str)
@settings(max_examples=200)
@given(rates, times, st.floats(-40, 150), st.floats(-40, 150))
def test_relaxation_stays_between_its_ends_and_meets_them(dtype, rate, time, ambient_c, initial_c):
    ambient, initial = (torch.tensor(x + 273.15, dtype=dtype) for x in (ambient_c, initial_c))
    found = relax(torch.tensor(time, dtype=torch.float64), ambient, initial[None], double(rate).to(dtype))[0]
    slack = 2 * torch.finfo(dtype).eps * 450
    assert min(ambient, initial) - slack <= found <= max(ambient, initial) + slack
    if rate * time == 0:
        assert found == initial
    if rate * time > 200:
        assert found == ambient
    truth = ambient.item() + (initial.item() - ambient.item()) * math.exp(-rate * time)
    assert found.item() == pytest.approx(truth, abs=slack)


@pytest.mark.parametrize("dtype", JOINT, ids=str)
@settings(max_examples=150)
@given(
    st.one_of(st.floats(-80, 30), st.sampled_from([-80.0, 30.0, -69.0776])),
    logarithmic(1e-5, 3e2, 0.0), st.one_of(times, times.map(lambda t: -t)),
)  # fmt: skip
def test_gradients_by_everything_are_finite(dtype, log_rate, omega, time):
    leaves = {
        "ambient": torch.tensor(290.0, dtype=dtype), "initial": torch.tensor([310.0], dtype=dtype),
        "log_rate": torch.tensor([log_rate], dtype=dtype), "sine": torch.ones(1, 1, dtype=dtype),
        "cosine": torch.ones(1, 1, dtype=dtype),
    }  # fmt: skip
    for leaf in leaves.values():
        leaf.requires_grad_()
    moment, ambient, initial = torch.tensor(time, dtype=torch.float64), leaves["ambient"], leaves["initial"]
    rate = leaves["log_rate"].exp()
    temperature(moment, ambient, initial, rate, double(omega), leaves["sine"], leaves["cosine"]).sum().backward()
    assert [name for name, leaf in leaves.items() if not leaf.grad.isfinite().all()] == []
    if math.exp(log_rate) * abs(time) < 1e-9:
        assert leaves["initial"].grad.item() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("dtype", JOINT, ids=str)
@settings(max_examples=100)
@given(logarithmic(1e-9, 100.0, 0.0), st.sampled_from([-1.0, 1.0]))
def test_radiation_near_the_reference_keeps_its_digits(dtype, excess, sign):
    found = power_excess(double(sign * excess).to(dtype), 288.0).item()
    with mpmath.workdps(50):
        truth = ((288 + mpmath.mpf(sign * excess)) ** 4 - mpmath.mpf(288) ** 4) / (4 * mpmath.mpf(288) ** 3)
    assert abs(found - truth) <= 4 * torch.finfo(dtype).eps * abs(truth)


@settings(max_examples=100)
@given(logarithmic(1e-13, 1e9, 0.0))
def test_weights_of_a_step_keep_their_digits(y):
    """Rates from 1e-9 to 1e4 1/s and steps from 0.01 s to an hour, and beyond."""
    decay, before, after = (x.item() for x in step_weights(double(y), 1.0))
    assert min(decay, before, after) >= 0 and decay + before + after == pytest.approx(1, abs=3e-16)
    with mpmath.workdps(50):
        phi = -mpmath.expm1(-mpmath.mpf(y)) / y if y else mpmath.mpf(1)
        truth = (mpmath.exp(-mpmath.mpf(y)), phi - mpmath.exp(-mpmath.mpf(y)), 1 - phi)
    assert max(abs(a - b) for a, b in zip((decay, before, after), truth, strict=True)) <= 4e-16


@settings(max_examples=40)
@given(
    logarithmic(1e-9, 1e4), logarithmic(0.01, 3600.0), st.floats(-20, 60), st.one_of(st.just(0.0), st.floats(0.01, 0.99)),
)  # fmt: skip
def test_a_stiff_balance_neither_rings_nor_leaves_the_range_of_what_drives_it(rate, step, start, share):
    air = torch.tensor([0.0, 20.0, -10.0, 5.0, 30.0, -20.0, 0.0], dtype=torch.float64)
    moments = step * torch.arange(len(air), dtype=torch.float64)
    climate = Climate(Drivers(moments, 288.0, air, sky=air))
    leaves = [torch.tensor([x], dtype=torch.float64).requires_grad_() for x in (start, math.log(rate), 0.0, share)]
    found = stepped_temperature(climate, Surface(*leaves), moments[-1].item())
    found.sum().backward()
    low, high = min(start, -20.0), max(start, 30.0)
    assert low - 2.0 <= found.item() <= high + 2.0
    assert all(leaf.grad.isfinite().all() for leaf in leaves)
    if rate * step < 1e-7:
        assert found.item() == pytest.approx(start, abs=1e-3)
    if share == 0.0 and rate * step > 1e4:
        assert found.item() == pytest.approx(0.0, abs=0.01)


@settings(max_examples=200)
@given(
    st.lists(logarithmic(1e-3, 1e9, 0.0), min_size=2, max_size=12), st.integers(1, 30), logarithmic(1e-6, 1e6),
    st.one_of(st.floats(1e-3, 1), st.sampled_from([1.0, 1 - 2**-53, 1e-3])),
)  # fmt: skip
@example([0.0, 1e-3, 1e5], 2, 1e-4, 1 - 1e-9)
@example([1.0, 1.000000238418579, 1e-3], 1, 1.0, 1.0)
def test_the_frequency_grid_lies_between_its_bounds(values, count, tau_min, gain):
    moments = torch.tensor(values, dtype=torch.float64)
    span = (moments.max() - moments.min()).item()
    omega = frequency_grid(moments, count, tau_min, gain, separation=0.0)
    assert omega.isfinite().all() and (omega > 0).all() and (omega.diff() > 0).all() and len(omega) <= count
    if span > 1e-2:
        assert len(omega) == count
        lowest = 2 * math.pi * max(1 / span, LOWEST_HZ)
        gaps = moments.sort().values.diff()
        rel = 1e-12 + gaps[gaps <= 1e-6].sum().item() / span  # moments as close as that count as one
        assert omega[0].item() == pytest.approx(lowest, rel=rel)
        sampled = math.pi / gaps[gaps > 1e-6].min().item()
        with mpmath.workdps(50):
            followed = float(mpmath.sqrt(1 / mpmath.mpf(gain) ** 2 - 1) / tau_min)
        highest = max(min(sampled, followed), NARROWEST_BAND * lowest)
        assert count == 1 or omega[-1].item() == pytest.approx(highest, rel=rel)


BANDS = Band(), Band(3.0, 5.0), Band(8.0, 8.1), Band(10.0, 1000.0)
SENT = {
    torch.float32: 2e-7,
    torch.float64: 5e-14,
}  # relative, down to 1e-30 W/(m² sr); e^{-x} multiplies an error of x by x


@pytest.mark.parametrize("dtype", SENT, ids=str)
@settings(max_examples=40)
@given(logarithmic(1.0, 1e4, 300.0), logarithmic(1.0, 1000.0, 7.5))
@example(1e4, 1e5)  # far beyond, where e^x - 1 is all rounding
@example(1.0, 1.0)
def test_what_a_black_body_sends_keeps_its_digits(dtype, temperature, wavelength):
    """Bands from 1 .. 1000 µm to twice that, on which x is anything between 7e-4 and 1.4e4."""
    kelvins = double(temperature).to(dtype).requires_grad_()
    sent = Band(wavelength, 2 * wavelength).radiance(kelvins)
    sent.sum().backward()
    with mpmath.workdps(30):
        band = mpmath.mpf(temperature), mpmath.mpf(wavelength), 2 * mpmath.mpf(wavelength)
        truth, slope = float(band_radiance(*band)), float(band_slope(*band))
    assert abs(sent.item() - truth) <= SENT[dtype] * (truth + 1e-30)
    assert abs(kelvins.grad.item() - slope) <= SENT[dtype] * (slope + 1e-30)


@pytest.mark.parametrize("dtype", SENT, ids=str)
@settings(max_examples=40)
@given(logarithmic(12.0, 9.9e3, 300.0), st.sampled_from(BANDS))
def test_a_temperature_is_found_again_in_what_it_sends(dtype, temperature, band):
    radiance = band.radiance(double(temperature).to(dtype)).requires_grad_()
    if radiance.item() <= torch.finfo(dtype).tiny:
        return
    found = band.temperature(radiance)
    found.sum().backward()
    assert found.item() == pytest.approx(temperature, rel=SENT[dtype])
    kelvins = double(temperature).to(dtype).requires_grad_()
    band.radiance(kelvins).sum().backward()
    assert radiance.grad.item() * kelvins.grad.item() == pytest.approx(1, rel=50 * SENT[dtype])


@settings(max_examples=100)
@given(st.lists(st.one_of(logarithmic(1e-45, 3e38, 0.0), st.floats(-1e3, 0)), min_size=2, max_size=8))
def test_temperatures_rise_with_radiance_whatever_it_is(values):
    radiances = double(*sorted(values)).requires_grad_()
    found = BANDS[0].temperature(radiances)
    found.sum().backward()
    assert (found.diff() >= -1e-9).all() and found.min() >= 1 and found.max() <= 1e4
    assert radiances.grad.isfinite().all() and (radiances.grad >= 0).all()
