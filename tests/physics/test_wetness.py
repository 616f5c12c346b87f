"""Rain on surfaces: wet bulbs, films that dry, and the air that wet surfaces find, beside the yard's own solver."""

import math

import numpy as np
import pytest
import torch

from heatsplat.contracts import Weather
from heatsplat.datamodules.synthetic_scene import layered_heat
from heatsplat.datamodules.synthetic_scene.layered_heat import Body, Layer, Patches, Sky
from heatsplat.physics.units import celsius, kelvin
from heatsplat.physics.walls import CONVECTION
from heatsplat.physics.wetness import (
    AIR_J_M3_K,
    COVERS_MM,
    LATENT_J_KG,
    rained_on,
    vapour_kg_m3,
    wet_bulb_k,
    wet_share,
    wetted,
)

HOUR_S = 3600.0


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def stull(air_c: float, humidity: float) -> float:
    """Wet bulb in °C at 1013 hPa, to within 0.3 °C for the most part (Stull 2011, Eq. 1)."""
    first = air_c * math.atan(0.151977 * math.sqrt(humidity + 8.313659)) + math.atan(air_c + humidity)
    return (
        first - math.atan(humidity - 1.676331) + 0.00391838 * humidity**1.5 * math.atan(0.023101 * humidity) - 4.686035
    )


def test_wet_bulbs_are_those_of_a_published_fit():
    for air_c, humidity in ((20.0, 50.0), (30.0, 20.0), (30.0, 60.0), (5.0, 80.0)):
        found = celsius(wet_bulb_k(kelvin(tensor(air_c)), tensor(humidity)))
        assert found.item() == pytest.approx(stull(air_c, humidity), abs=0.45), (air_c, humidity)
    saturated = kelvin(tensor(-5.0, 15.0, 40.0))
    assert (wet_bulb_k(saturated, tensor(100.0, 100.0, 100.0)) - saturated).abs().max() < 1e-9
    assert vapour_kg_m3(saturated).numpy() / layered_heat.saturated_kg_m3(saturated.numpy())[0] == pytest.approx(
        1, 1e-4
    )


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_exchange_of_a_wet_surface_is_exact_as_warm_as_the_air_and_as_the_wet_bulb(share):
    air, humidity = kelvin(tensor(-3.0, 12.0, 28.0, 35.0)), tensor(90.0, 55.0, 30.0, 100.0)
    found, times = wetted(air, humidity, torch.full_like(air, share))
    for surface in (air, wet_bulb_k(air, humidity)):
        latent = LATENT_J_KG / AIR_J_M3_K * (vapour_kg_m3(surface) - vapour_kg_m3(air, humidity))
        torch.testing.assert_close(times * (found - surface), air - surface - share * latent, rtol=0, atol=1e-6)
    if share == 0.0:
        assert torch.equal(found, air) and (times == 1.0).all()


def test_a_film_fills_runs_off_and_dries():
    times = torch.arange(0.0, 12 * HOUR_S, 600.0, dtype=torch.float64)
    air, humidity = torch.full_like(times, kelvin(20.0)), torch.full_like(times, 50.0)
    rain = torch.where((times >= HOUR_S) & (times <= 2 * HOUR_S), 3.0, 0.0).double()
    wet = wet_share(times, rain, air, humidity, None, 0.3)
    before, during = times < HOUR_S - 600, (times > HOUR_S + 600) & (times < 2 * HOUR_S)
    assert (wet[before] == 0).all() and (wet[during] == 1).all() and wet[-1] == 0
    rate = CONVECTION[0] / AIR_J_M3_K * float(vapour_kg_m3(air)[0] - vapour_kg_m3(air, humidity)[0])

    film, truth = 0.0, [0.0]
    for k in range(len(times) - 1):
        for second in range(600):  # as it is said, second by second
            falls = np.interp(600.0 * k + second, times.numpy(), rain.numpy()) / HOUR_S
            film = min(max(film + falls - rate * min(film / COVERS_MM, 1.0), 0.0), 0.3)
        truth.append(min(film / COVERS_MM, 1.0))
    assert np.abs(wet.numpy() - truth).max() < 0.03
    longer, windy = (
        wet_share(times, rain, air, humidity, *more) for more in ((None, 0.6), (torch.full_like(air, 5.0), 0.3))
    )
    assert longer.sum() > wet.sum() + 3 > windy.sum() + 6
    assert (wet_share(times, 0 * rain, air, humidity, None, 0.3) == 0).all()
    damp = wet_share(times, rain, air, torch.full_like(air, 100.0), None, 0.3)
    assert (damp[during | (times > 2 * HOUR_S)] == 1).all()  # nothing dries in saturated air


@pytest.mark.parametrize("step_s", [1.0, 600.0])
def test_drizzle_wets_however_often_it_is_recorded(step_s):
    times = torch.arange(0.0, 2401.0, step_s, dtype=torch.float64)
    air, humidity = torch.full_like(times, kelvin(12.0)), torch.full_like(times, 98.0)
    rain = torch.where(times <= 1800.0, 0.3, 0.0).double()
    wet = wet_share(times, rain, air, humidity, None, 0.3)
    assert wet[times == 600.0].item() == pytest.approx(0.5, abs=0.02) and wet[times == 1800.0] == 1


def test_wet_sheet_metal_is_as_cold_as_the_solver_of_the_yard_has_it():
    times = np.arange(0.0, 6 * HOUR_S + 1, 600.0)
    air = kelvin(22.0 + 4.0 * np.sin(times / HOUR_S))
    vapour = 0.45 * layered_heat.saturated_kg_m3(air)[0]
    humidity = torch.from_numpy(100.0 * vapour / layered_heat.saturated_kg_m3(air)[0])
    rain = np.where(times >= HOUR_S, 2.0, 0.0)
    body = Body((Layer(50.0, 3.6e6, 0.001),), 0.0, 12.0, 0.0, holds_kg_m2=0.5)
    sky = Sky(times, air, 0 * times, vapour, rain / HOUR_S, 0 * times)
    patch = Patches(np.array([0]), np.array([0.0]), np.array([0.0]), np.zeros((len(times), 1)))
    truth = layered_heat.solve([body], patch, sky, float(air[0]), step_s=60.0)
    wet = wet_share(*(torch.from_numpy(one) for one in (times, rain, air)), humidity, None, 0.5)
    found, faster = (one.numpy() for one in wetted(torch.from_numpy(air), humidity, wet))
    now, rate = float(air[0]), 12.0 / (3.6e6 * 0.001)
    for k, time in enumerate(truth.times_s[1:], start=1):
        settles = np.interp(time, times, found)
        now = settles + (now - settles) * np.exp(-60.0 * rate * np.interp(time, times, faster))
        if k % 30 == 0 and time > 1.5 * HOUR_S:
            assert now == pytest.approx(truth.surface_k[k, 0], abs=0.35)
            assert now < np.interp(time, times, air) - 4.0


def test_a_record_without_rain_or_moisture_wets_nothing():
    times = torch.arange(0.0, 4 * HOUR_S, 600.0, dtype=torch.float64)
    series = {"air_c": 15.0 + 0 * times, "humidity_percent": 60.0 + 0 * times, "rain_mm_h": 1.0 + 0 * times}
    assert rained_on(Weather(times, **series), 0.3)[-1] == 1.0
    for missing in series:
        assert rained_on(Weather(times, **{name: one for name, one in series.items() if name != missing}), 0.3) is None
