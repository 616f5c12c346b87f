"""What images tell of effects: clear ones, chance, heat that looks like a camera, and too few frames."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from effects.tracks import COOLING, DRIFTING, FRAMES, NOTHING, PASSED, POINTS, data_of, drawn, fit_to, levels

from heatsplat.effects.joint.certainty import MIN_DB, ROUGH, Certainty
from heatsplat.effects.joint.courses import ANY
from heatsplat.effects.joint.evidence import gained
from heatsplat.effects.joint.fit import Fit, fit_of
from heatsplat.effects.joint.model import Model
from heatsplat.effects.physical import agc, frame_offset
from heatsplat.effects.physical.attenuation import with_distance
from heatsplat.effects.physical.frame_offset import common_to_all


@pytest.fixture(scope="module")
def cooling():
    return fit_to(COOLING)


def looked(fit, model):
    return SimpleNamespace(joint=(fit, model), obs=SimpleNamespace(why=""), certainty=Certainty(fit, model))


def test_a_clear_effect_is_told_and_one_of_chance_is_not(cooling):
    model = Model.of(relaxation=1)
    evidence = gained(looked(cooling, model), "relaxation", "points change by")
    assert evidence.told and evidence.gain_db > MIN_DB and evidence.statistic > 2.5
    still = fit_to(levels())
    chance = gained(looked(still, model), "relaxation", "points change by")
    assert chance.told and chance.statistic == 0.0 and "nothing is lost without it" in chance.reason


def test_a_lamp_that_few_frames_cannot_follow_is_not_taken_for_the_camera():
    """Half of the points are lit: what images have in common is not common to all."""
    lit = drawn(POINTS, 1, seed=11) > 0
    fit = fit_to(levels() + 0.05 * lit * drawn(FRAMES, seed=9))
    certainty = Certainty(fit, Model.of(frame_offset=1))
    assert "not common to all points" in certainty.doubts["frame_offset"]
    assert {"relaxation", "harmonic_source"} <= set(certainty.doubts)
    assert not Certainty(fit_to(DRIFTING), Model.of(frame_offset=1)).doubts


def test_too_few_frames_are_told_with_how_many_are_needed():
    data = data_of(COOLING + 0.05 * drawn(POINTS, 1, seed=10) * torch.sin(9 * PASSED))
    data.tracks.weights[:, [f for f in range(FRAMES) if f not in (0, 4, 9, 13, 18, 22, 27)]] = 0
    fit = fit_of(data)
    assert data.usual_length == 7
    evidence = gained(looked(fit, NOTHING), "harmonic_source", "points change by")
    assert not evidence.told and evidence.statistic is None
    assert evidence.reason == "cannot be told: of 30 frames 7 see a point, and 13 are needed"


def test_offsets_stay_where_gains_beside_them_are_left_out():
    """A gain for each image brings a shift that takes the offsets; where gains are nothing they are still there."""
    found = looked(fit_to(DRIFTING), Model.of(frame_offset=1, agc=1))
    gains, offsets = agc.EFFECT.evidence(found), frame_offset.EFFECT.evidence(found)
    assert gains.statistic == 0.0 and "nothing is lost without it" in gains.reason
    assert offsets.told and offsets.statistic > frame_offset.EFFECT.threshold and offsets.gain_db > 5
    stretched = levels() * (1 + 0.2 * drawn(FRAMES, seed=14)) + 0.1 * drawn(FRAMES, seed=15)
    both = looked(fit_to(stretched), Model.of(frame_offset=1, agc=1))
    assert agc.EFFECT.evidence(both).statistic > agc.EFFECT.threshold
    assert frame_offset.EFFECT.evidence(both).statistic == 0.0


def test_a_drift_that_goes_as_heat_may_be_heat():
    cooling = Certainty(fit_to(levels() + 0.1 * torch.exp(-3 * PASSED)), Model.of(frame_offset=1))
    assert "goes over time as a scene may" in cooling.doubts["frame_offset"]
    assert {"relaxation", "harmonic_source"} <= set(cooling.doubts)


def test_offsets_are_common_to_all_though_most_of_what_is_left_is_something_else():
    """Half of the points are placed badly, so that offsets explain little of what they leave."""
    bad = 0.2 * (torch.arange(POINTS)[:, None] % 2) * drawn(POINTS, FRAMES, seed=16)
    fit = fit_to(DRIFTING + bad)
    assert common_to_all(fit, Model.of(frame_offset=1), NOTHING)
    lit = fit_to(levels() + bad + 0.05 * (drawn(POINTS, 1, seed=11) > 0) * drawn(FRAMES, seed=9))
    assert not common_to_all(lit, Model.of(frame_offset=1), NOTHING)


def test_offsets_that_few_frames_cannot_tell_from_heat_leave_it_open():
    """Few frames see half of the points lit: offsets explain much, and whether anything changes cannot be told."""
    lit = drawn(POINTS, 1, seed=11) > 0
    data = data_of(levels() + 0.05 * lit * drawn(FRAMES, seed=9))
    data.tracks.weights[:, [f for f in range(FRAMES) if f not in (0, 4, 9, 13, 18, 22, 27)]] = 0
    certainty = Certainty(fit_of(data), Model.of(frame_offset=1))
    assert "frame_offset" in certainty.doubts
    assert "are needed" in certainty.few("relaxation") and "are needed" in certainty.few("harmonic_source")


def test_points_may_warm_where_heat_was_taken_in_or_nobody_can_tell():
    assert Certainty(fit_to(COOLING), Model.of(relaxation=1)).may_warm
    assert not Certainty(fit_to(levels()), NOTHING).may_warm
    assert not Certainty(fit_to(DRIFTING), Model.of(frame_offset=1)).may_warm
    alike = Certainty(fit_to(levels() + 0.1 * torch.exp(-3 * PASSED)), Model.of(frame_offset=1))
    assert alike.may_warm  # in doubt
    data = data_of(COOLING + 0.05 * drawn(POINTS, 1, seed=10) * torch.sin(9 * PASSED))
    data.tracks.weights[:, [f for f in range(FRAMES) if f not in (0, 4, 9, 13, 18, 22, 27)]] = 0
    assert Certainty(fit_of(data), NOTHING).may_warm  # too few frames


def test_what_is_left_out_is_undecided_only_if_it_may_gain_where_it_was_not_fitted(monkeypatch):
    certainty = Certainty(fit_to(DRIFTING), NOTHING)
    monkeypatch.setattr(Fit, "gain", lambda fit, more, less: 1.5)
    assert certainty.undecided(Model.of(frame_offset=1), "frame_offset")
    still = Certainty(fit_to(levels()), NOTHING)
    monkeypatch.setattr("heatsplat.effects.joint.certainty.worthwhile", lambda *_: True)
    assert not still.undecided(Model.of(frame_offset=1), "frame_offset")


def test_beside_a_rough_weather_record_a_camera_has_to_outdo_any_change():
    """Surfaces that follow the record in their own measure, with a course of which it knows nothing."""
    drivers = torch.sin(5 * PASSED)[:, None]
    unknown = 0.05 * drawn(POINTS, 1, seed=12) * drawn(FRAMES, seed=13)
    fit = fit_of(data_of(levels() + 0.05 + unknown, drivers=drivers))
    certainty = Certainty(fit, Model.of(frame_offset=1))
    assert certainty.doubts["frame_offset"] == ROUGH
    assert certainty.beside_weather(NOTHING).names == {ANY}
    drifting = Certainty(fit_of(data_of(DRIFTING, drivers=drivers)), Model.of(frame_offset=1))
    assert not drifting.doubts


def test_haze_is_told_from_what_near_and_far_points_lose_alike():
    fades = torch.exp(-0.5 - 0.3 * torch.sin(6 * PASSED))
    model = Model.of(attenuation="varying")
    data = data_of(levels() * fades)
    alike = fit_of(replace(data, ambient=0.0))
    assert not with_distance(alike, model, NOTHING)
    depths = (0.5 + 0.3 * torch.sin(6 * PASSED)) * data.tracks.distances / data.tracks.distances.mean()
    haze = data_of(levels() * torch.exp(-depths))
    assert with_distance(fit_of(replace(haze, ambient=0.0)), model, NOTHING)


def test_frames_that_are_explained_leave_nothing_for_another_effect():
    data = data_of(levels())
    data.tracks.weights[:, 1::3] = 0
    data.tracks.weights[:, 2::3] = 0
    certainty = Certainty(fit_of(data), NOTHING)
    assert certainty.explained and not certainty.few("harmonic_source")
