"""What a weather record drives surfaces by: which part says what, and that rain comes last."""

import math
from dataclasses import replace

import pytest
import torch

from heatsplat.contracts import SceneError, Weather
from heatsplat.thermal.energy_balance import EnergyBalance
from heatsplat.thermal.surface_drivers import drivers_of

REFERENCE_K = 288.15


def weather(**changes) -> Weather:
    """A day by the hour with all series, a shower in its third hour."""
    times = torch.arange(0, 86401, 3600.0, dtype=torch.float64)
    angle = 2 * math.pi * times / 86400
    sun = torch.nn.functional.normalize(torch.stack((angle.sin(), 0.6 * angle.cos() - 1.2, -angle.cos()), dim=1), dim=1)
    record = Weather(
        times,
        air_c=16 - 6 * angle.cos(),
        wind_m_s=3 - 2 * angle.cos(),
        humidity_percent=60 + 20 * angle.cos(),
        irradiance_w_m2=500 * sun[:, 2].clamp(min=0),
        direct_w_m2=torch.where(sun[:, 2] > 0, 700.0, 0.0).double(),
        diffuse_w_m2=100 * sun[:, 2].clamp(min=0).sqrt(),
        rain_mm_h=torch.where(times == 2 * 3600.0, 2.0, 0.0).double(),
        sun=sun,
    )
    return replace(record, **changes)


def driven(record=None, mean_wind=3.0, **options):
    return drivers_of(record or weather(), EnergyBalance(**options).options, REFERENCE_K, mean_wind)


def test_every_part_adds_its_drivers_and_reports_its_effects():
    everything = {"nodes": 2, "shadows": True, "sky_view": True, "albedo": 0.2, "rain": 0.3, "inner": True}
    drivers, effects = driven(**everything)
    assert [name for name, series in vars(drivers).items() if series is None] == ["room"]
    assert list(effects) == ["convection", "relaxation", "solar", "shadows", "sky_view", "albedo", "radiation"]
    assert list(effects["convection"]) == ["air", "from_within", "wind", "rain"]


def test_what_is_off_adds_nothing():
    drivers, effects = driven(sun=False, sky=None, wind=False)
    assert {name for name, value in vars(drivers).items() if value is not None} == {"times_s", "reference_k", "air"}
    assert effects == {"convection": {"air": "recorded"}}


def test_what_the_weather_lacks_is_left_out_and_said():
    bare = weather(wind_m_s=None, humidity_percent=None, irradiance_w_m2=None, direct_w_m2=None)
    _, effects = driven(bare, mean_wind=0.0, rain=0.3)
    assert list(effects["convection"]) == ["air", "left_out_sun", "left_out", "left_out_rain"]
    assert effects["radiation"]["left_out"].startswith("humidity") and "solar" not in effects
    with pytest.raises(SceneError, match="trained with wind"):
        driven(bare, mean_wind=3.0)


def test_wind_that_training_did_not_have_is_left_out_and_said(caplog):
    for exchange in ("learned", "iso_6946"):
        caplog.clear()
        _, effects = driven(mean_wind=0.0, exchange=exchange)
        assert effects["convection"]["left_out"] == "wind, of which there was none in training"
        assert "wind" not in effects["convection"] and "as in still air" in caplog.text
    caplog.clear()
    _, effects = driven(weather(wind_m_s=torch.zeros_like(weather().air_c)), mean_wind=0.0, exchange="iso_6946")
    assert effects["convection"]["wind"] == "recorded, 0 m/s throughout" and not caplog.text


def test_rain_changes_the_air_of_wet_surfaces_and_not_their_sky():
    dry, _ = driven()
    wet, _ = driven(rain=0.3)
    assert bool((wet.air < dry.air).any()) and bool((wet.air == dry.air).any())
    assert bool(((wet.wetted > 1) == (wet.air < dry.air)).all())
    assert torch.equal(wet.sky, dry.sky) and torch.equal(wet.around, dry.around)
