"""Band radiance and its inverse against a series in 30 digits."""

import mpmath
import pytest
import torch
from physics.planck_reference import band_radiance, band_slope, constants

from heatsplat.physics.planck import Band

TEMPERATURES = (3.0, 12.0, 40.0, 150.0, 300.0, 1000.0, 9e3)
EPSILON = {torch.float32: 1.2e-7, torch.float64: 1e-12}


def double(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


@pytest.mark.parametrize("dtype", EPSILON, ids=str)
@pytest.mark.parametrize("temperature", TEMPERATURES)
def test_radiance_and_slope_agree_with_thirty_digits(dtype, temperature):
    kelvins = double(temperature).to(dtype).requires_grad_()
    found = Band().radiance(kelvins)
    found.sum().backward()
    with mpmath.workdps(30):
        truth, slope = band_radiance(mpmath.mpf(temperature)), band_slope(mpmath.mpf(temperature))
    least = torch.finfo(dtype).tiny
    assert found.item() == pytest.approx(float(truth), rel=EPSILON[dtype], abs=least)
    assert kelvins.grad.item() == pytest.approx(float(slope), rel=EPSILON[dtype], abs=least)


def test_the_reference_agrees_with_an_adaptive_quadrature():
    first, second = constants()
    with mpmath.workdps(30):
        found = mpmath.quad(
            lambda nu: first * nu**3 / mpmath.expm1(second * nu / 300),
            [10**6 / mpmath.mpf(14), 10**6 / mpmath.mpf("7.5")],
        )
        assert abs(found / band_radiance(mpmath.mpf(300)) - 1) < 1e-12


@pytest.mark.parametrize("dtype", EPSILON, ids=str)
@pytest.mark.parametrize("temperature", TEMPERATURES[1:])
def test_the_inverse_finds_the_temperature_again_and_has_the_inverse_slope(dtype, temperature):
    with mpmath.workdps(30):
        radiance = double(float(band_radiance(mpmath.mpf(temperature)))).to(dtype).requires_grad_()
        slope = float(band_slope(mpmath.mpf(temperature)))
    found = Band().temperature(radiance)
    found.sum().backward()
    assert found.item() == pytest.approx(temperature, rel=EPSILON[dtype])
    assert radiance.grad.item() == pytest.approx(1 / slope, rel=20 * EPSILON[dtype])


def test_an_image_is_what_its_pixels_are_and_comes_back_to_far_below_a_float32():
    kelvins = torch.linspace(200.0, 1500.0, 70_000, dtype=torch.float64).view(200, 350)
    band = Band(nodes=16)
    sent = band.radiance(kelvins)
    assert torch.equal(sent, band.with_slope(kelvins)[0])  # however many are worked out at once
    found = band.temperature(sent)
    assert (found / kelvins - 1).abs().max() < 2e-14 and (found.diff(dim=1) > 0).all()
    learning = sent.clone().requires_grad_()
    assert torch.equal(band.temperature(learning), found)
    turned = band.temperature(sent.T)
    assert torch.equal(turned, found.T) and torch.equal(band.radiance(kelvins.T), sent.T)
    assert band.radiance(kelvins[:0]).shape == band.temperature(sent[:0]).shape == (0, 350)


def test_gradients_of_both_are_those_of_finite_differences():
    kelvins = double(200.0, 300.0, 450.0).requires_grad_()
    assert torch.autograd.gradcheck(Band(nodes=16).radiance, kelvins)
    radiances = Band().radiance(kelvins.detach()).requires_grad_()
    assert torch.autograd.gradcheck(Band(nodes=16).temperature, radiances)


@pytest.mark.parametrize("dtype", EPSILON, ids=str)
def test_ends_and_beyond_are_finite(dtype):
    kelvins = torch.tensor([-50.0, 0.0, 1e-30, 1.0, 1e4, 1e9], dtype=dtype, requires_grad=True)
    sent = Band().radiance(kelvins)
    sent.sum().backward()
    assert sent.isfinite().all() and kelvins.grad.isfinite().all()
    assert (sent[:4] == 0).all() and sent[5] == sent[4] > 5e4 and kelvins.grad[5] == 0
    radiances = torch.tensor([-1.0, 0.0, 1e-44, 1e9], dtype=dtype, requires_grad=True)
    seen = Band().temperature(radiances)
    seen.sum().backward()
    assert seen.isfinite().all() and radiances.grad.isfinite().all()
    assert 1 <= seen[0] == seen[1] < 12 and abs(seen[3] - 1e4) < 0.1 and radiances.grad[3] == 0


def test_a_band_that_is_none_is_refused():
    with pytest.raises(ValueError, match=r"two rising positive wavelengths and at least 1 node, got 14 .. 7.5"):
        Band(14, 7.5)
    with pytest.raises(ValueError, match="at least 1 node"):
        Band(nodes=0)
