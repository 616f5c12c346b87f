"""Which fields of ``Drivers`` each part of a record fills, and with what."""

from dataclasses import replace

import torch

from heatsplat.contracts import Weather
from heatsplat.physics.drivers import of_sky, of_sunlight, of_water
from heatsplat.physics.surfaces import power_excess
from heatsplat.physics.units import kelvin


def tensor(*values: float) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64)


RECORD = Weather(
    tensor(0.0, 3600.0),
    air_c=tensor(10.0, 12.0),
    humidity_percent=tensor(80.0, 60.0),
    irradiance_w_m2=tensor(500.0, 600.0),
    direct_w_m2=tensor(700.0, 800.0),
    diffuse_w_m2=tensor(100.0, 120.0),
    rain_mm_h=tensor(3.6, 0.0),
    sun=tensor(0.6, 0.8, 0.0).reshape(3, 1).expand(3, 2).T.contiguous(),
)


def test_light_is_told_by_direction_only_where_surfaces_and_the_record_have_one():
    tilted = of_sunlight(RECORD, tilted=True)
    assert list(tilted) == ["up", "light", "beams"]
    torch.testing.assert_close(tilted["beams"], tensor(0.42, 0.56, 0.0, 0.48, 0.64, 0.0).reshape(2, 3))
    torch.testing.assert_close(tilted["light"], tensor(0.1, 0.12))
    for level in (of_sunlight(RECORD, tilted=False), of_sunlight(replace(RECORD, sun=None), tilted=True)):
        assert list(level) == ["light"] and torch.equal(level["light"], tensor(0.5, 0.6))
    assert of_sunlight(replace(RECORD, irradiance_w_m2=None), tilted=False) == {}


def test_surfaces_that_lean_see_what_is_as_warm_as_the_air():
    sky_k = kelvin(tensor(-5.0, -3.0))
    drivers = of_sky(RECORD, sky_k, 283.0, tilted=True)
    assert torch.equal(drivers["sky"], power_excess(sky_k - 283.0, 283.0))
    assert torch.equal(drivers["around"], of_sky(RECORD, kelvin(RECORD.air_c), 283.0, tilted=False)["sky"])
    assert list(of_sky(RECORD, sky_k, 283.0, tilted=False)) == ["sky"]


def test_vapour_is_known_where_anything_evaporates():
    wet = of_water(RECORD, 0.3, transpires=False)
    assert list(wet) == ["rain", "dries", "holds_mm", "vapour"] and wet["holds_mm"] == 0.3
    torch.testing.assert_close(wet["rain"], tensor(0.001, 0.0))
    assert list(of_water(RECORD, None, transpires=True)) == ["vapour"] and of_water(RECORD, None, False) == {}
