"""The radiometric chain against 40 digits, against itself backwards, and its uncertainty against chance."""

import math
from dataclasses import replace

import mpmath
import numpy as np
import pytest
import torch
from physics.planck_reference import band_radiance

from heatsplat.physics.radiometry import (
    PARAMETERS,
    Atmosphere,
    BandResponse,
    Conditions,
    PlanckResponse,
    directional_emissivity,
    measured_signal,
    sensitivities,
    surface_temperature,
    transmittance,
    uncertainty,
)

DUO = PlanckResponse(364058.0, 1428.0, 1.0, -228, 1.0)  # of a FLIR Duo Pro R
ONE = PlanckResponse(17945.85, 1435.0, 1.0, -2539, 0.0125)  # of a FLIR ONE Pro
BENT = PlanckResponse(21106.77, 1501.0, 1.37, -7340, 0.0109)  # F is not 1 in every camera
HAZY = Conditions(0.93, 285.0, 120.0, 291.0, 0.65, 0.9, 295.0)
RESPONSES = [DUO, ONE, BENT, BandResponse()]


def double(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def exact_signal(response, kelvin):
    if isinstance(response, BandResponse):
        return band_radiance(mpmath.mpf(kelvin))
    r1, b, f, o, r2 = (mpmath.mpf(getattr(response, name)) for name in ("r1", "b", "f", "o", "r2"))
    return r1 / (r2 * (mpmath.exp(b / mpmath.mpf(kelvin)) - f)) - o


def exact_measured(surface, response, c):
    """The chain as FLIR writes it down, from its terms one by one."""
    t = mpmath.mpf(c.air_k) - mpmath.mpf("273.15")
    cubic = [mpmath.mpf(x) for x in ("1.5587", "0.06939", "-0.00027816", "6.8455e-7")]
    water = mpmath.mpf(c.humidity) * mpmath.exp(cubic[0] + cubic[1] * t + cubic[2] * t**2 + cubic[3] * t**3)
    a = c.atmosphere
    first, second = (
        mpmath.exp(-mpmath.sqrt(mpmath.mpf(c.distance_m)) * (mpmath.mpf(alpha) + mpmath.mpf(beta) * mpmath.sqrt(water)))
        for alpha, beta in ((a.alpha_1, a.beta_1), (a.alpha_2, a.beta_2))
    )
    tau = mpmath.mpf(a.x) * first + (1 - mpmath.mpf(a.x)) * second
    e, w = mpmath.mpf(c.emissivity), mpmath.mpf(c.window_transmission)
    s = [exact_signal(response, k) for k in (surface, c.reflected_k, c.air_k, c.window_k)]
    return e * tau * w * s[0] + (1 - e) * tau * w * s[1] + (1 - tau) * w * s[2] + (1 - w) * s[3], tau


@pytest.mark.parametrize("response", RESPONSES, ids=lambda r: type(r).__name__)
@pytest.mark.parametrize("kelvin", [233.15, 300.0, 650.0])
def test_what_a_camera_measures_agrees_with_forty_digits(response, kelvin):
    with mpmath.workdps(40):
        truth, tau = exact_measured(kelvin, response, HAZY)
    assert HAZY.transmittance().item() == pytest.approx(float(tau), rel=1e-14)
    assert measured_signal(double(kelvin), response, HAZY).item() == pytest.approx(float(truth), rel=1e-13)


@pytest.mark.parametrize("response", RESPONSES, ids=lambda r: type(r).__name__)
def test_the_surface_is_found_again(response):
    kelvin = torch.linspace(200.0, 1200.0, 200, dtype=torch.float64)
    found = surface_temperature(measured_signal(kelvin, response, HAZY), response, HAZY)
    assert (found - kelvin).abs().max() < 1e-9


def test_a_pixel_has_conditions_of_its_own():
    distances = double(1.0, 30.0, 400.0)
    each = replace(HAZY, distance_m=distances)
    signals = measured_signal(double(300.0, 300.0, 300.0), DUO, each)
    for i, metres in enumerate(distances.tolist()):
        assert signals[i] == measured_signal(double(300.0), DUO, replace(HAZY, distance_m=metres))[0]


def test_no_correction_is_no_operation():
    counts = double(2500.0, 3000.0)
    assert not Conditions(reflected_k=250.0, air_k=310.0, window_k=400.0).corrects
    assert torch.equal(surface_temperature(counts, DUO, Conditions()), DUO.kelvin(counts))
    for name, value in (("emissivity", 0.9), ("distance_m", 5.0), ("window_transmission", 0.8)):
        assert Conditions(**{name: value}).corrects


def test_what_cannot_be_is_no_temperature():
    assert torch.isnan(ONE.kelvin(double(2539.0, 0.0))).all()  # at and below the offset
    bright = Conditions(emissivity=0.1, reflected_k=400.0)
    assert torch.isnan(surface_temperature(DUO.signal(double(250.0)), DUO, bright)).all()
    assert torch.isnan(surface_temperature(BandResponse().signal(double(250.0)), BandResponse(), bright)).all()
    assert torch.isnan(transmittance(1e5, 303.15, 0.9))  # the formula falls below zero


@pytest.mark.parametrize(
    ("distance", "celsius", "humidity"), [(1.0, 20.0, 0.5), (50.0, 20.0, 0.3), (100.0, -10.0, 0.9), (500.0, 35.0, 0.8)]
)
def test_air_lets_less_pass_the_longer_and_the_wetter_it_is(distance, celsius, humidity):
    here = transmittance(distance, celsius + 273.15, humidity)
    assert 0 < here < 1
    assert transmittance(1.5 * distance, celsius + 273.15, humidity) < here
    assert transmittance(distance, celsius + 273.15, min(1.0, humidity + 0.1)) < here
    assert transmittance(0.0, celsius + 273.15, humidity) == 1


@pytest.mark.parametrize("response", [DUO, BandResponse()], ids=lambda r: type(r).__name__)
def test_sensitivities_are_those_of_finite_differences(response):
    signal = measured_signal(double(280.0, 320.0), response, HAZY)
    found = sensitivities(signal, response, HAZY)
    for name in PARAMETERS:
        step = 1e-5 * getattr(HAZY, name)
        above, below = (
            surface_temperature(signal, response, replace(HAZY, **{name: getattr(HAZY, name) + sign * step}))
            for sign in (1, -1)
        )
        torch.testing.assert_close(found[name], (above - below) / (2 * step), rtol=1e-5, atol=1e-9)
    apparent = response.kelvin(signal)
    above, below = (surface_temperature(response.signal(apparent + d), response, HAZY) for d in (1e-4, -1e-4))
    torch.testing.assert_close(found["camera"], (above - below) / 2e-4, rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("air", [{}, {"humidity": 0.0}, {"humidity": 0.0, "distance_m": 10.0}])
def test_nothing_is_infinite_where_there_is_no_air_or_no_water_in_it(air):
    found = sensitivities(DUO.signal(double(300.0)), DUO, Conditions(emissivity=0.9, **air))
    assert all(torch.isfinite(slope).all() for slope in found.values())
    assert found["humidity"] == 0 and (found["distance_m"] == 0) == ("distance_m" not in air)


def test_propagated_uncertainty_is_the_spread_that_chance_gives():
    standard = {
        "emissivity": 0.01,
        "reflected_k": 3.0,
        "distance_m": 12.0,
        "air_k": 2.0,
        "humidity": 0.05,
        "camera": 0.5,
    }
    signal = measured_signal(double(310.0), DUO, HAZY)
    stated = uncertainty(signal, DUO, HAZY, standard)
    rng = np.random.default_rng(0)
    drawn = {
        name: torch.from_numpy(rng.normal(getattr(HAZY, name), u, 200_000))
        for name, u in standard.items()
        if name != "camera"
    }
    apparent = DUO.kelvin(signal) + torch.from_numpy(rng.normal(0, standard["camera"], 200_000))
    spread = surface_temperature(DUO.signal(apparent), DUO, replace(HAZY, **drawn)).std()
    assert stated["combined"].item() == pytest.approx(spread.item(), rel=0.02)
    assert stated["combined"] < sum(stated[name] for name in standard)
    assert stated["camera"] > standard["camera"]  # the air and the emissivity dilute what the camera sees


def test_dry_air_is_as_uncertain_as_moisture_would_matter():
    dry, signal = replace(HAZY, humidity=0.0), measured_signal(double(310.0), DUO, replace(HAZY, humidity=0.0))
    stated = uncertainty(signal, DUO, dry, {"humidity": 0.05, "camera": 0.5})
    changed = surface_temperature(signal, DUO, replace(dry, humidity=0.05)) - 310.0
    assert stated["humidity"].item() == pytest.approx(changed.abs().item(), rel=1e-6) and changed.abs() > 0.05
    assert stated["combined"].item() == pytest.approx(math.hypot(changed.item(), stated["camera"].item()), rel=1e-6)
    near = uncertainty(signal, DUO, replace(dry, distance_m=0.0), {"humidity": 0.05})
    assert near["combined"] == 0


def test_the_constants_of_the_air_count():
    dry = Atmosphere(beta_1=0.0, beta_2=0.0)
    assert transmittance(100.0, 293.15, 0.1, dry) == transmittance(100.0, 293.15, 0.9, dry)


@pytest.mark.parametrize("index", [1.3, 1.5, 4.0])
@pytest.mark.parametrize("degrees", [0.0, 45.0, 80.0, 89.9])
def test_emissivity_at_an_angle_is_that_of_fresnel(index, degrees):
    """Against the amplitudes of both polarisations by Snell's law in 40 digits."""
    with mpmath.workdps(40):
        angle, n = mpmath.radians(mpmath.mpf(degrees)), mpmath.mpf(index)
        inside = mpmath.asin(mpmath.sin(angle) / n)
        cos_i, cos_t = mpmath.cos(angle), mpmath.cos(inside)
        s, p = (cos_i - n * cos_t) / (cos_i + n * cos_t), (n * cos_i - cos_t) / (n * cos_i + cos_t)
        truth = mpmath.mpf("0.9") * (1 - (s**2 + p**2) / 2) / (1 - ((n - 1) / (n + 1)) ** 2)
        cosine = double(float(cos_i))
    assert directional_emissivity(0.9, cosine, index).item() == pytest.approx(float(truth), rel=1e-9, abs=1e-12)
