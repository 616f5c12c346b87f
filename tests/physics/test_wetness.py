"""Vapour of air and of wet surfaces, beside the yard's own solver and a published fit."""

import math

import pytest
import torch

from heatsplat.contracts import Weather
from heatsplat.datamodules.synthetic_scene import layered_heat
from heatsplat.physics.units import kelvin
from heatsplat.physics.walls import CONVECTION
from heatsplat.physics.wetness import LATENT_J_KG, drying_mm_s_k, vapour_k, vapour_kg_m3


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


def stull(air_c: float, humidity: float) -> float:
    """Wet bulb in °C at 1013 hPa, to within 0.3 °C for the most part (Stull 2011, Eq. 1)."""
    first = air_c * math.atan(0.151977 * math.sqrt(humidity + 8.313659)) + math.atan(air_c + humidity)
    return (
        first - math.atan(humidity - 1.676331) + 0.00391838 * humidity**1.5 * math.atan(0.023101 * humidity) - 4.686035
    )


@pytest.mark.parametrize(("air_c", "humidity"), [(20.0, 50.0), (30.0, 20.0), (30.0, 60.0), (5.0, 80.0)])
def test_a_wet_surface_that_exchanges_heat_with_the_air_alone_is_as_cold_as_a_wet_bulb(air_c, humidity):
    bulb, full = kelvin(tensor(stull(air_c, humidity))), tensor(100.0)
    lacks = vapour_k(bulb, full) - vapour_k(kelvin(tensor(air_c)), tensor(humidity))
    slope = vapour_k(bulb + 1.0, full) - vapour_k(bulb, full)
    error_k = (bulb + lacks - kelvin(tensor(air_c))) / (1.0 + slope)
    assert error_k.abs().item() < 0.45


def test_saturated_air_holds_what_the_solver_of_the_yard_has_it_hold():
    air = kelvin(tensor(-5.0, 15.0, 40.0))
    assert vapour_kg_m3(air).numpy() / layered_heat.saturated_kg_m3(air.numpy())[0] == pytest.approx(1, 1e-4)


def test_films_dry_faster_in_wind_as_convection_by_convention_does():
    times = tensor(0.0, 600.0)
    calm, windy = (drying_mm_s_k(Weather(times, wind_m_s=wind)) for wind in (None, tensor(5.0, 0.0)))
    assert torch.equal(calm, torch.full_like(times, CONVECTION[0] / LATENT_J_KG)) and windy[1] == calm[1]
    assert windy[0].item() == pytest.approx((CONVECTION[0] + 5.0 * CONVECTION[1]) / LATENT_J_KG)
