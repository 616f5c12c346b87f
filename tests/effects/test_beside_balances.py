"""A camera beside balances of heat, on bodies that were integrated in small steps."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from tracks import FRAMES, POINTS, data_of, drawn
from weathered import HOUR_S, make_weather

from heatsplat.effects import weather_record
from heatsplat.effects.beside_balances import beside_balances, beyond_balances
from heatsplat.effects.full_balance import FullBalance
from heatsplat.effects.joint.fit import fit_of
from heatsplat.effects.joint.model import Model
from heatsplat.effects.physical.frame_offset import as_balances_err
from heatsplat.physics.sky import sky_temperature_k
from heatsplat.physics.units import KELVIN_AT_0_C, STEFAN_BOLTZMANN, kelvin

UNIT_K, NOISE_K, STEP_S = 40.0, 0.1, 30.0
WEATHER = make_weather(direct_w_m2=None, diffuse_w_m2=None, sun=None)
SKY_K = sky_temperature_k(kelvin(WEATHER.air_c), WEATHER.humidity_percent, "brutsaert")
MOMENTS = torch.sort(
    18.0 * HOUR_S * torch.rand(FRAMES, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
).values
WALK_K = 0.8 * drawn(FRAMES, seed=21).cumsum(0)  # of a sensor that drifts
WALK_K = WALK_K - WALK_K.mean()


@cache
def temperatures() -> torch.Tensor:
    """Of level bodies with a core [P, F] in °C, by explicit steps of 30 s."""
    takes, emits, capacity, core = torch.rand(
        4, POINTS, generator=torch.Generator().manual_seed(3), dtype=torch.float64
    )
    takes, emits, capacity, core = 0.3 + 0.6 * takes, 0.8 + 0.15 * emits, 1e4 + 5e4 * capacity, 1e5 + 3e5 * core
    steps = np.arange(float(WEATHER.times_s[0]), float(MOMENTS[-1]) + STEP_S, STEP_S)
    series = [kelvin(WEATHER.air_c), SKY_K, WEATHER.irradiance_w_m2, WEATHER.wind_m_s / WEATHER.wind_m_s.mean()]
    courses = np.stack([np.interp(steps, WEATHER.times_s, one) for one in series]).T
    state, inside, found = torch.full_like(takes, courses[0, 0]), torch.full_like(takes, 288.0), []
    for air, sky_k, light, wind in courses.tolist():
        found.append(state)
        inwards = 6.0 * (state - inside)
        heat = takes * light + emits * STEFAN_BOLTZMANN * (sky_k**4 - state**4) + 4.0 * (1.0 + wind) * (air - state)
        state, inside = state + STEP_S * (heat - inwards) / capacity, inside + STEP_S * inwards / core
    at = np.rint((MOMENTS.numpy() - steps[0]) / STEP_S)
    return torch.stack(found)[at].T - KELVIN_AT_0_C


def beside(celsius, weights=None):
    """What is made of images of these temperatures [P, F]; weights [P, F] that count 0 leave out."""
    drivers = weather_record.drivers(WEATHER, MOMENTS)
    data = replace(data_of(celsius / UNIT_K, noise=NOISE_K / UNIT_K, drivers=drivers), times_s=MOMENTS)
    if weights is not None:
        data = replace(data, tracks=replace(data.tracks, weights=weights))
    fit = fit_of(data)
    values, errors = UNIT_K * data.tracks.values, UNIT_K * fit.errors
    balances = FullBalance(WEATHER, SKY_K, MOMENTS, values, errors, data.tracks.weights, None)
    return beside_balances(fit, balances, UNIT_K)


def test_an_even_camera_that_keeps_its_level_adds_nothing():
    fit, model = beside(temperatures())
    assert not model.names, model
    assert fit.variances(model).median() < 1.3


def test_a_sensor_that_drifts_is_told_from_a_day_of_weather():
    fit, model = beside(temperatures() + WALK_K)
    assert model.names == {"frame_offset"}, model
    found = UNIT_K * fit.contributions(model)["frame_offset"][0]
    assert torch.corrcoef(torch.stack([found, WALK_K]))[0, 1] > 0.85


def test_a_lens_that_fades_towards_the_corners_is_found():
    radii = data_of(temperatures()).tracks.radii
    _, model = beside(temperatures() * (1.0 - 0.2 * radii / radii.max()))
    assert model.names == {"vignetting"}, model


def test_points_that_something_else_heats_follow_no_balance():
    lamp = 8.0 * torch.rand(POINTS, 1, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    assert beside(temperatures() + lamp * (torch.arange(FRAMES) % 2)) is None


@pytest.mark.parametrize(("frames", "told"), [(8, False), (FRAMES, True)])
def test_few_frames_tell_no_balance_and_a_camera(frames, told):
    weights = torch.zeros(POINTS, FRAMES, dtype=torch.float64)
    weights[:, :: FRAMES // frames] = 1.0
    assert (beside(temperatures(), weights) is not None) == told


@pytest.mark.parametrize(("common", "heat"), [(0.3 * temperatures().mean(0), True), (WALK_K, False)])
def test_what_all_balances_may_miss_is_no_drift(common, heat):
    fit, _ = beside(temperatures() + common)
    assert as_balances_err(fit, Model.of(frame_offset=1), Model()) == heat


def test_without_balances_nothing_errs_as_they_do():
    fit = fit_of(data_of(temperatures() / UNIT_K + WALK_K / UNIT_K, noise=NOISE_K / UNIT_K))
    assert not as_balances_err(fit, Model.of(frame_offset=1), Model())


def test_what_balances_could_say_as_well_is_not_taken_from_the_points():
    fit, model = beside(temperatures() + WALK_K)
    walk = fit.contributions(model)["frame_offset"]
    assert beyond_balances(fit, model, walk) is walk  # as no balance goes
    ways = fit.own(model)[1][..., 1:]
    heat = 30.0 * ways.sum(2)
    kept = beyond_balances(fit, model, heat + walk)
    least = beyond_balances(fit, model, walk - 60.0 * ways[..., 0])
    used = fit.weights > 0
    assert kept[used].abs().max() < 0.2 * heat[used].abs().max()
    assert torch.allclose(kept[used], least[used], atol=1e-3)  # of the walk, what no balance says
    assert kept[used].abs().max() > 0.1 * walk.abs().max()


def test_nothing_added_stays_nothing():
    fit, model = beside(temperatures() + WALK_K)
    assert not beyond_balances(fit, model, torch.zeros_like(fit.weights)).any()
