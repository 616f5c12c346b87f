"""The balance of one-sided slabs against a sum by hand."""

import pytest
import torch
from weathered import HOUR_S, make_weather

from heatsplat.physics.units import KELVIN_AT_0_C, STEFAN_BOLTZMANN
from heatsplat.thermal.surface_balance import SurfaceBalance
from heatsplat.thermal.weather_drive import sunlight_at

UP, EAST, WEST = [0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]
BODY = {"emissivity": 0.9, "absorptivity": 0.7, "convection": 12.0, "capacity": 2e6}


def test_a_slab_is_lit_from_its_front_and_half_of_what_a_wall_sees_is_the_ground():
    balance, weather, time_s = SurfaceBalance("swinbank", 0.03), make_weather(), 2.5 * HOUR_S
    body = {name: torch.full((3,), value) for name, value in BODY.items()}
    rate = balance.rate(torch.full((3,), 300.0), body, {"normals": torch.tensor([UP, EAST, WEST])}, weather, time_s)
    (sun, direct), (_, diffuse) = sunlight_at(weather, time_s)
    assert sun[0] > 0.5 and sun[2] > 0.5
    air_k = weather.at(time_s).air_c + KELVIN_AT_0_C
    sky_k = 0.0552 * air_k**1.5
    for found, facing, share in zip(rate, (float(sun[2]), float(sun[0]), 0.0), (1.0, 0.5, 0.5), strict=True):
        around = share * sky_k**4 + (1 - share) * air_k**4
        watts = 0.7 * (direct * facing + diffuse * share) - 12.0 * (300.0 - air_k)
        watts -= 0.9 * STEFAN_BOLTZMANN * (300.0**4 - around)
        assert float(found) == pytest.approx(watts / (2e6 * 0.03), rel=1e-4)


def test_under_no_sky_a_slab_that_faces_up_by_rounding_more_than_that_has_a_temperature():
    up = torch.tensor([-0.32, 0.18, 0.93], dtype=torch.float64)
    normal = (1.0 + 3e-7) * (up / up.norm()).float()
    weather = make_weather(up=up / up.norm())
    body = {name: torch.full((1,), value) for name, value in BODY.items()}
    rate = SurfaceBalance("none", 0.03).rate(torch.full((1,), 300.0), body, {"normals": normal[None]}, weather, 0.0)
    assert rate.isfinite().all()


def test_a_slab_has_a_thickness():
    with pytest.raises(ValueError, match="depth_m must be positive, got 0"):
        SurfaceBalance("none", 0.0)
