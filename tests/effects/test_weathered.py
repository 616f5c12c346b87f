"""Balances of heat with and without sun, sky and wind, on points whose heat is known."""

import pytest
import torch
from weathered import HOUR_S, make_weather

from heatsplat.effects.weathered import EXCHANGE_W_M2_K, PARTS, Weathered, judged
from heatsplat.physics.sky import sky_temperature_k
from heatsplat.physics.units import KELVIN_AT_0_C, STEFAN_BOLTZMANN

POINTS, FRAMES, STEP_S = 60, 48, 120.0


def recorded(without="", depth=0.0):
    """Points under a weather, integrated in small steps; noise of 0.1 K."""
    weather = make_weather()
    generator = torch.Generator().manual_seed(3)
    rate = torch.exp(torch.rand(POINTS, generator=generator, dtype=torch.float64) * 2.0) / (4 * HOUR_S)
    takes = 0.3 + 0.5 * torch.rand(POINTS, generator=generator, dtype=torch.float64)
    emits = 0.3 + 0.4 * torch.rand(POINTS, generator=generator, dtype=torch.float64)
    times = torch.sort(18 * HOUR_S * torch.rand(FRAMES, generator=generator, dtype=torch.float64)).values
    now, temperature, values = float(weather.times_s[0]), torch.full((POINTS,), 15.0, dtype=torch.float64), []
    core = temperature
    for time in times.tolist():
        while now < time:
            here = weather.at(now)
            air_k = torch.tensor(here.air_c + KELVIN_AT_0_C, dtype=torch.float64)
            moist = torch.tensor(here.humidity_percent, dtype=torch.float64)
            net = STEFAN_BOLTZMANN * float(sky_temperature_k(air_k, moist, "brutsaert") ** 4 - air_k**4)
            wind = 1.0 if without == "convection" else (1 + 1.5 * here.wind_m_s / float(weather.wind_m_s.mean())) / 2.5
            driven = wind * (here.air_c - temperature)
            driven = driven + (without != "solar") * takes * here.irradiance_w_m2 / EXCHANGE_W_M2_K
            driven = driven + (without != "radiation") * emits * net / EXCHANGE_W_M2_K
            temperature, core = (
                temperature + STEP_S * rate * (driven + depth * (core - temperature)),
                core + STEP_S * rate * 0.1 * (temperature - core),
            )
            now += STEP_S
        values.append(temperature)
    values = torch.stack(values, 1) + 0.1 * torch.randn(POINTS, FRAMES, generator=generator, dtype=torch.float64)
    ones = torch.ones_like(values)
    return Weathered(weather, times, values, 0.1 * ones, ones, None)


def test_what_drives_a_scene_is_told():
    seen = recorded()
    for name in PARTS:
        evidence = judged(seen, name, "")
        assert evidence.told and evidence.statistic > 3 and evidence.gain_db > 0.2, (name, evidence)


@pytest.mark.parametrize("name", PARTS)
def test_what_does_not_drive_a_scene_is_not_taken_in(name):
    evidence = judged(recorded(without=name), name, "")
    assert not (evidence.told and evidence.statistic > 3), evidence


def test_a_body_with_a_core_has_two_nodes():
    assert recorded(depth=3.0).nodes == 2


def test_without_a_record_nothing_is_told():
    evidence = judged(None, "solar", "there is no record")
    assert not evidence.told and evidence.reason == "there is no record"
