"""What a weather record drives surfaces by, and which part says what."""

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
    everything["transpires"] = True
    drivers, effects = driven(**everything)
    assert [name for name, series in vars(drivers).items() if series is None] == ["room"]
    assert list(effects) == ["convection", "relaxation", "solar", "shadows", "sky_view", "albedo", "radiation"]
    assert list(effects["convection"]) == ["air", "from_within", "wind", "transpires", "rain"]


def test_what_is_off_adds_nothing():
    drivers, effects = driven(sun=False, sky=None, wind=False)
    there = {name for name, value in vars(drivers).items() if value is not None}
    assert there == {"times_s", "reference_k", "air", "holds_mm"} and drivers.holds_mm == 0
    assert effects == {"convection": {"air": "recorded"}}


def test_what_the_weather_lacks_is_left_out_and_said():
    bare = weather(wind_m_s=None, humidity_percent=None, irradiance_w_m2=None, direct_w_m2=None)
    _, effects = driven(bare, mean_wind=0.0, rain=0.3)
    assert list(effects["convection"]) == ["air", "left_out_sun", "left_out", "left_out_rain"]
    assert effects["radiation"]["left_out"].startswith("humidity") and "solar" not in effects
    with pytest.raises(SceneError, match="trained with wind"):
        driven(bare, mean_wind=3.0)
    with pytest.raises(SceneError, match="transpires=true needs humidity_percent"):
        driven(bare, mean_wind=0.0, transpires=True)


def test_wind_that_training_did_not_have_is_left_out_and_said(caplog):
    for exchange in ("learned", "iso_6946"):
        caplog.clear()
        _, effects = driven(mean_wind=0.0, exchange=exchange)
        assert effects["convection"]["left_out"] == "wind, of which there was none in training"
        assert "wind" not in effects["convection"] and "as in still air" in caplog.text
    caplog.clear()
    _, effects = driven(weather(wind_m_s=torch.zeros_like(weather().air_c)), mean_wind=0.0, exchange="iso_6946")
    assert effects["convection"]["wind"] == "recorded, 0 m/s throughout" and not caplog.text


def test_rain_brings_water_and_vapour_and_changes_nothing_else():
    dry, _ = driven()
    wet, effects = driven(rain=0.3)
    assert effects["convection"]["rain"] == "2 mm, of which surfaces hold up to 0.3"
    gained = {name for name, series in vars(wet).items() if getattr(dry, name) is None and series is not None}
    assert gained == {"vapour", "rain", "dries"}
    for name in set(vars(dry)) - gained - {"holds_mm"}:
        here, there = getattr(wet, name), getattr(dry, name)
        assert torch.equal(here, there) if isinstance(there, torch.Tensor) else here == there, name
    # 2 mm an hour for an hour in the mean of two; 80 % humidity at 10 °C is 7.5 g/m³, times Λ / (ρ c) of 2042 K m³/kg
    assert wet.rain.max().item() * 3600 == pytest.approx(2.0) and wet.holds_mm == 0.3
    assert wet.vapour[0].item() == pytest.approx(15.4, abs=0.2)
    # 4 + 4 v in W/(m² K) over 2.45 MJ/kg
    assert wet.dries[0].item() == pytest.approx((4 + 4 * 1.0) / 2.45e6)
    rainless, effects = driven(weather(rain_mm_h=torch.zeros_like(weather().air_c)), rain=0.3)
    assert rainless.rain is rainless.vapour is None and effects["convection"]["rain"].startswith("0 mm")


def test_transpiration_needs_no_rain():
    drivers, effects = driven(transpires=True)
    assert drivers.rain is None and drivers.vapour is not None
    assert "share" in effects["convection"]["transpires"]
