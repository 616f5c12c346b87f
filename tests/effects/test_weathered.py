"""Balances of heat with and without sun, sky and wind, on points whose heat is known."""

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import pytest
import torch
from weathered import HOUR_S, make_weather

from heatsplat.contracts import Weather
from heatsplat.effects import weather_record
from heatsplat.effects.joint.held_out import HeldOut
from heatsplat.effects.weathered import (
    ALBEDO,
    EXCHANGE_W_M2_K,
    MIN_DB,
    MIRRORED,
    PART_SIGMAS,
    PARTS,
    SHADOWS,
    SIGMAS,
    SKY_VIEW,
    Weathered,
    around,
    judged,
    told_of_clouds,
    told_of_water,
    water_on,
    weighed,
)
from heatsplat.physics.sky import sky_temperature_k
from heatsplat.physics.units import KELVIN_AT_0_C, STEFAN_BOLTZMANN
from heatsplat.physics.wetness import FILM_MM

POINTS, FRAMES, STEP_S = 60, 48, 120.0


@cache
def recorded_at(time_s):
    """What the weather of all recordings here is at a moment, their clouds aside."""
    return make_weather().at(time_s)


def recorded(without="", depth=0.0, lit=None, clouds=None, **seen):
    """Points under a weather, integrated in small steps; noise of 0.1 K.

    Args:
        clouds: (hours of the record) -> share of the sky that they close; None: the sky is clear, and the record tells none.
        lit: (the sun's direction) -> whether each point is lit by its beams; None: they are level, and irradiance is all light.
        seen: what ``Weathered`` knows beside temperatures.
    """
    weather = make_weather()
    if clouds is not None:
        weather = replace(weather, clouds=clouds(weather.times_s / HOUR_S))
    generator = torch.Generator().manual_seed(3)
    rate = torch.exp(torch.rand(POINTS, generator=generator, dtype=torch.float64) * 2.0) / (4 * HOUR_S)
    takes = 0.3 + 0.5 * torch.rand(POINTS, generator=generator, dtype=torch.float64)
    emits = 0.3 + 0.4 * torch.rand(POINTS, generator=generator, dtype=torch.float64)
    times = torch.sort(18 * HOUR_S * torch.rand(FRAMES, generator=generator, dtype=torch.float64)).values
    now, temperature, values = float(weather.times_s[0]), torch.full((POINTS,), 15.0, dtype=torch.float64), []
    core = temperature
    for time in times.tolist():
        while now < time:
            here = recorded_at(now)
            air_k = torch.tensor(here.air_c + KELVIN_AT_0_C, dtype=torch.float64)
            moist = torch.tensor(here.humidity_percent, dtype=torch.float64)
            at = int((weather.times_s - now).abs().argmin())
            closed = 0.0 if clouds is None or without == "clouds" else float(weather.clouds[at])
            net = STEFAN_BOLTZMANN * float(sky_temperature_k(air_k, moist, "brutsaert", closed) ** 4 - air_k**4)
            wind = 1.0 if without == "convection" else (1 + 1.5 * here.wind_m_s / float(weather.wind_m_s.mean())) / 2.5
            driven = wind * (here.air_c - temperature)
            light = here.irradiance_w_m2
            if lit is not None:
                beam = float(weather.direct_w_m2[at] * weather.sun[at, 2].clamp_min(0))
                light = beam * lit(weather.sun[at]) + float(weather.diffuse_w_m2[at])
            driven = driven + (without != "solar") * takes * light / EXCHANGE_W_M2_K
            driven = driven + (without != "radiation") * emits * net / EXCHANGE_W_M2_K
            temperature, core = (
                temperature + STEP_S * rate * (driven + depth * (core - temperature)),
                core + STEP_S * rate * 0.1 * (temperature - core),
            )
            now += STEP_S
        values.append(temperature)
    values = torch.stack(values, 1) + 0.1 * torch.randn(POINTS, FRAMES, generator=generator, dtype=torch.float64)
    ones = torch.ones_like(values)
    return Weathered(weather, times, values, 0.1 * ones, ones, **{"normals": None, **seen})


def test_what_drives_a_scene_is_told():
    seen = recorded()
    for name in PARTS:
        evidence = judged(seen, name, "")
        assert evidence.told and evidence.statistic > 3 and evidence.gain_db > 0.2, (name, evidence)


@pytest.mark.parametrize("name", PARTS)
def test_what_does_not_drive_a_scene_is_not_taken_in(name):
    evidence = judged(recorded(without=name), name, "")
    assert not (evidence.told and evidence.statistic > PART_SIGMAS), evidence


def test_a_sky_under_clouds_is_told_from_a_clear_one():
    def passing(hours):
        return 0.5 + 0.5 * torch.sin(2.0 * torch.pi * hours / 5.0)

    assert recorded(clouds=passing).clouded
    clear = recorded(clouds=passing, without="clouds")
    assert not clear.clouded and "; clouds leave the sky cold (gain -" in told_of_clouds(clear)
    assert not recorded().clouded


def test_clouds_of_a_fair_day_warm_the_sky_though_nobody_can_tell():
    assert recorded(clouds=lambda hours: 0.02 + 0.0 * hours, without="clouds").clouded


NONE = HeldOut(-0.1, -1.0, 48)


def gains(linear: HeldOut, full: HeldOut = NONE, share: float = 0.0) -> SimpleNamespace:
    """Points whose balances gain this by each part, of which bodies take this share."""
    shares = {"solar": share, "radiation": share}
    return SimpleNamespace(gain=lambda name: linear, full_gain=lambda name: full, shares=shares, dark=True)


@pytest.mark.parametrize(("sigmas", "likely"), [(1.7, True), (0.6, True), (0.4, False), (-1.7, False)])
def test_wind_in_doubt_is_likely_where_it_gains(sigmas, likely):
    assert judged(gains(HeldOut(0.1 * sigmas, sigmas, 48)), "convection", "").likely == likely


@pytest.mark.parametrize(
    ("linear", "full", "told", "sigmas"),
    [
        (HeldOut(0.3, 2.5, 48), HeldOut(0.01, 0.1, 48), True, 2.5),  # few frames
        (HeldOut(0.0, 0.0, 48), HeldOut(0.1, 3.0, 48), True, 3.0),  # many
        (HeldOut(0.1, 4.0, 48), HeldOut(0.1, 3.0, 48), True, 3.0),  # linear ones gain too little
        (HeldOut(0.1, 1.5, 48), HeldOut(0.02, 1.0, 48), False, 1.5),
        (HeldOut(0.04, 0.4, 48), HeldOut(-0.1, -1.0, 48), True, 0.4),  # absent
    ],
)
def test_the_balances_that_tell_more_are_asked(linear, full, told, sigmas):
    evidence = judged(gains(linear, full), "convection", "")
    assert (evidence.told, evidence.statistic) == (told, sigmas)


def test_rain_that_nobody_recorded_or_that_did_not_fall_wets_nothing():
    dry = make_weather(rain_mm_h=torch.zeros_like(make_weather().times_s))
    for weather in (make_weather(), dry, make_weather(rain_mm_h=dry.rain_mm_h + 1.0, humidity_percent=None)):
        assert not replace(recorded(), weather=weather).rained


@pytest.mark.parametrize(("bent", "tracks", "told"), [(True, True, True), (False, True, False), (True, False, False)])
def test_water_is_told_to_a_balance_that_is_solved_as_it_stands(monkeypatch, bent, tracks, told):
    monkeypatch.setattr("heatsplat.effects.weathered.weather_record.bent", lambda obs: bent)
    obs = SimpleNamespace(tracks=object() if tracks else None)
    for rained, transpires in ((True, True), (True, False), (False, True), (False, False)):
        gained = {"rain": HeldOut(0.25, 3.1, 48), "plants": HeldOut(0.01, 0.1, 48)}
        weathered = SimpleNamespace(rained=rained, transpires=transpires, **gained)
        seen = SimpleNamespace(weathered=weathered, obs=obs)
        assert water_on(seen) == {"rain": FILM_MM if told and rained else None, "transpires": told and transpires}
        found = told_of_water(seen)
        assert ("rain wets surfaces (gain 0.25 dB, 3.1 standard errors)" in found) == (told and rained)
        assert ("surfaces do not transpire (gain 0.01" in found) == (told and not transpires)
    assert told_of_water(SimpleNamespace(weathered=None, obs=obs)) == "" == told_of_clouds(None)
    assert water_on(SimpleNamespace(weathered=None, obs=obs)) == {"rain": None, "transpires": False}


def test_a_body_with_a_core_has_two_nodes():
    assert recorded(depth=3.0).nodes == 2


@pytest.mark.parametrize(
    "name, gain, share, told",
    [
        ("solar", HeldOut(0.0, -0.1, 9), 0.11, False),  # bodies take light that few frames do not show where left out
        ("solar", HeldOut(0.0, -0.1, 9), 0.02, True),
        ("radiation", HeldOut(-0.03, -0.5, 9), 0.15, False),
        ("radiation", HeldOut(-0.03, -0.5, 9), 0.02, True),
        ("convection", HeldOut(0.04, 3.4, 16), 0.0, False),  # small, but no chance
        ("convection", HeldOut(0.04, 1.0, 16), 0.0, True),
    ],
)
def test_a_part_is_absent_if_it_gains_nothing_and_nothing_says_that_it_may_be_there(name, gain, share, told):
    evidence = judged(gains(gain, share=share), name, "")
    assert evidence.told == told and evidence.statistic < 4, evidence


def test_what_full_balances_gain_is_large_whatever_linear_ones_take_for_it():
    told = judged(gains(NONE, HeldOut(6.0, 10.0, 48), share=0.05), "radiation", "")
    assert told.told and told.statistic == 10.0
    assert not judged(gains(HeldOut(6.0, 10.0, 48), share=0.05), "radiation", "").told


def test_without_a_record_nothing_is_told():
    evidence = judged(None, "solar", "there is no record")
    assert not evidence.told and evidence.reason == "there is no record"


def by_a_wall():
    """Level ground on both sides of a wall from south to north, 2 m high, of points; and what lights it."""
    generator = torch.Generator().manual_seed(4)
    ground = torch.rand(POINTS, 3, generator=generator, dtype=torch.float64) * torch.tensor([4.0, 4.0, 0.0])
    ground[:, 0] -= 2.0
    along = torch.arange(0.0, 4.0, 0.1, dtype=torch.float64)
    wall = torch.stack(torch.meshgrid(torch.zeros(1, dtype=torch.float64), along, along[:20], indexing="ij"), 3)
    up = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64).expand(POINTS, -1)
    tracks = SimpleNamespace(points=ground, directions=up[:, None].expand(-1, FRAMES, -1))

    def lit(sun):
        across = ground[:, 0] * sun[0] < 0
        return (~(across & (ground[:, 0].abs() * sun[2] < 2.0 * sun[0].abs()))).double()

    more = torch.rand(2000, 3, generator=generator, dtype=torch.float64) * torch.tensor([4.0, 4.0, 0.0])
    around = torch.cat([more - torch.tensor([2.0, 0.0, 0.0]), wall.flatten(0, 2), ground])
    return lit, {"normals": up, "tracks": tracks, "around": around}


def test_shadows_are_told_where_they_fall_and_not_where_they_do_not():
    lit, seen = by_a_wall()
    shaded, bare = recorded(lit=lit, **seen), recorded(lit=lambda sun: torch.ones(POINTS), **seen)
    found, none = (around(SimpleNamespace(weathered=one), SHADOWS) for one in (shaded, bare))
    assert found.told and found.statistic > SIGMAS, found
    assert none.told and none.statistic < SIGMAS, none
    for name in (ALBEDO, MIRRORED, SKY_VIEW):
        evidence = around(SimpleNamespace(weathered=bare), name)
        assert not (evidence.told and evidence.statistic > SIGMAS), (name, evidence)


def test_a_mirrored_sky_is_told_where_nobody_knows_where_the_sun_stands():
    """As where times are seconds of a clock that is not known."""
    _, seen = by_a_wall()
    directions = torch.randn(POINTS, FRAMES, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    directions[..., 2] = directions[..., 2].abs() + 0.1
    seen["tracks"].directions = directions / directions.norm(dim=2, keepdim=True)
    plain = recorded(lit=lambda sun: torch.ones(POINTS), **seen)
    plain = replace(plain, weather=replace(plain.weather, sun=None, direct_w_m2=None, diffuse_w_m2=None))
    mirroring = replace(plain, values=plain.values + 0.1 * plain._mirrored)
    found, none = (around(SimpleNamespace(weathered=one), MIRRORED) for one in (mirroring, plain))
    assert found.told and found.statistic > SIGMAS, found
    assert none.told and none.statistic < SIGMAS, none
    assert not around(SimpleNamespace(weathered=plain), SHADOWS).told


def test_points_that_follow_the_weather_are_no_levels_and_need_no_neighbours():
    _, seen = by_a_wall()
    weathered = recorded(lit=lambda sun: torch.ones(POINTS), **seen)
    assert weathered.follows.sigmas > SIGMAS and weathered.follows.db > 1.0
    assert weathered.flow.db < MIN_DB and recorded().flow is None


def test_a_certain_gain_that_is_too_small_does_not_ask_for_more_frames():
    for gain, large in ((HeldOut(2.5, 5.0, 48), False), (HeldOut(0.1, 5.0, 48), True)):
        evidence = weighed(gain, "found", large)
        assert not evidence.told and "too small" in evidence.reason and "frames" not in evidence.reason
    assert "from 36 frames, about 57 frames would tell" in weighed(HeldOut(2.5, 2.4, 36), "found").reason


def day_after_day(days, after=0):
    """A record of so many days before the first frame, and after the last one, as the weather of one day repeats itself."""
    times = HOUR_S / 2 * torch.arange(-48 * days, 48 * (after + 1), dtype=torch.float64)
    phase = 2.0 * torch.pi * times / (24 * HOUR_S)
    return Weather(
        times,
        air_c=15.0 + 5.0 * phase.sin() + torch.sin(phase / 11.0),
        wind_m_s=1.0 + (phase / 3.0).sin().abs(),
        humidity_percent=60.0 - 10.0 * phase.sin(),
        irradiance_w_m2=800.0 * phase.sin().clamp_min(0.0),
    )


def test_of_a_long_record_nothing_is_worked_out_that_bodies_have_forgotten_or_that_no_frame_sees(monkeypatch):
    """A record of a year took 20 s of the choice of effects; what came of it stays the same."""
    frames = torch.linspace(0.0, 10 * HOUR_S, 12, dtype=torch.float64)
    weather, ones = day_after_day(200, after=100), torch.ones(3, 12, dtype=torch.float64)
    seen = Weathered(weather, frames, 15.0 * ones, ones, ones, None)
    quick, slow = [1.0 / HOUR_S], [1.0 / (48 * HOUR_S)]

    def answers():
        found = [torch.cat(seen._answers(seen._drivers[0], seen._exchange(0.5), rates)[:1]) for rates in (quick, slow)]
        return [*found, weather_record.drivers(weather, frames)]

    few = len(weather.times_s[weather_record.remembered(weather.times_s, torch.tensor(quick), frames)])
    assert few < 48 * 2
    short = answers()
    monkeypatch.setattr(weather_record, "FORGOTTEN", torch.inf)
    for one, other in zip(short, answers(), strict=True):
        assert (one - other).abs().max() < 1e-6


def test_by_night_no_number_of_a_point_stands_for_sunlight():
    """The criterion counted three of them for each point, which explain nothing."""
    weather = day_after_day(3, after=2)
    by_day, by_night = (torch.linspace(first, first + 4, 12, dtype=torch.float64) * HOUR_S for first in (2.0, 18.0))
    sun = torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], dtype=torch.float64).repeat(len(weather.times_s) // 2, 1)
    weather = replace(weather, sun=sun, direct_w_m2=weather.irradiance_w_m2)
    assert weather_record.drivers(weather, by_day).shape == (12, 4)
    assert weather_record.drivers(weather, by_night).shape[1] == 3  # what bodies of four hours have not forgotten
    unlit = replace(weather, irradiance_w_m2=0 * weather.air_c, direct_w_m2=0 * weather.air_c)
    found = weather_record.drivers(unlit, by_night)
    assert found.shape == (12, 1) and found.norm() == pytest.approx(1.0)
    assert weather_record.drivers(replace(unlit, air_c=torch.ones_like(weather.air_c)), by_night).shape == (12, 1)


@pytest.mark.parametrize("frames_s", [[0.0, 90.0], [-5.0, 0.0], [200.0, 300.0], [60.0, 60.0]])
def test_what_bodies_remember_reaches_from_before_the_first_frame_to_after_the_last(frames_s):
    times = torch.tensor([0.0, 60.0, 120.0, 180.0], dtype=torch.float64)
    found = times[weather_record.remembered(times, torch.tensor([1.0]), torch.tensor(frames_s, dtype=torch.float64))]
    assert len(found) >= 2
    assert found[0] <= max(frames_s[0], 0.0) and found[-1] >= min(frames_s[-1], 180.0)
