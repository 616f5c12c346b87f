"""The weather of the yard, and what it does to faces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from heatsplat.datamodules.synthetic_scene.outdoor_sky import SKIES, forcing_of, outdoor_weather, sky_long_waves
from heatsplat.physics.units import KELVIN_AT_0_C, STEFAN_BOLTZMANN

UP, SOUTH_WALL = (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)


def test_the_sun_meets_faces_by_their_orientation_and_night_is_exactly_zero():
    weather = outdoor_weather("fair")
    east, west = (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)
    forcing = forcing_of(weather, np.array([UP, east, west, SOUTH_WALL]))
    solar_hour = (weather.times_s.numpy() / 3600.0 + 47.0 / 60.0 - 0.15) % 24.0  # 9° east is 36 minutes
    beam = forcing.sunlight_w_m2 - weather.diffuse_w_m2.numpy()[:, None] * np.array([1.0, 0.5, 0.5, 0.5])
    assert beam[(solar_hour > 14.0), 1].max() == pytest.approx(0.0, abs=1e-9)
    assert beam[(solar_hour < 11.0), 2].max() == pytest.approx(0.0, abs=1e-9)
    assert beam[:, 1].max() > 300.0 and beam[:, 2].max() > 300.0
    night = weather.sun[:, 2] < -0.02
    assert night.double().mean() > 0.25
    for series in (weather.direct_w_m2, weather.diffuse_w_m2, weather.irradiance_w_m2):
        assert (series[night] == 0).all() and series.max() > 100.0
    # Sun and sky together are what a level surface receives.
    level = weather.direct_w_m2 * weather.sun[:, 2].clamp_min(0.0) + weather.diffuse_w_m2
    assert (level - weather.irradiance_w_m2).abs().max() < 1.0
    assert np.allclose(forcing.sunlight_w_m2[:, 0], level.numpy(), atol=1e-9)


def test_the_sky_is_colder_than_the_air_and_moist_air_warms_it():
    weather = outdoor_weather("fair")
    air_k = weather.air_c.numpy() + KELVIN_AT_0_C
    sky_k = (sky_long_waves(weather) / STEFAN_BOLTZMANN) ** 0.25
    assert (air_k - sky_k).min() > 5.0 and (air_k - sky_k).max() < 30.0
    moist = replace(weather, humidity_percent=torch.full_like(weather.air_c, 95.0))
    assert (sky_long_waves(moist) > sky_long_waves(weather)).all()


def test_weathers_begin_alike_and_part_within_the_hour():
    fair = outdoor_weather("fair")
    for name in SKIES:
        other = outdoor_weather(name)
        for series in ("air_c", "wind_m_s", "humidity_percent", "irradiance_w_m2"):
            assert getattr(other, series)[0] == getattr(fair, series)[0]
        again = outdoor_weather.__wrapped__(name)  # worked out anew
        assert torch.equal(other.wind_m_s, again.wind_m_s) and torch.equal(other.direct_w_m2, again.direct_w_m2)
    later = slice(6, None)
    assert outdoor_weather("windy").wind_m_s[later].min() > 5.0
    assert outdoor_weather("calm").wind_m_s[later].max() < 1.0
    assert outdoor_weather("overcast").irradiance_w_m2.max() < 0.5 * fair.irradiance_w_m2.max()
    assert torch.equal(outdoor_weather("windy").irradiance_w_m2, fair.irradiance_w_m2)
