"""What images tell: gains where nothing was fitted, chance by shuffling, rivals, and too few frames."""

from types import SimpleNamespace

import pytest
import torch
from effects.tracks import FRAMES, PASSED, POINTS, data_of, drawn, fit_to, levels

from heatsplat.effects.joint.certainty import MIN_DB, MIN_SIGMAS, Certainty
from heatsplat.effects.joint.evidence import gained
from heatsplat.effects.joint.fit import fit_of
from heatsplat.effects.joint.held_out import FOLDS, compared, fold_of, shuffled, squares_of
from heatsplat.effects.joint.model import Model

COOLING = levels() + 0.1 * drawn(POINTS, 1, seed=8) * torch.exp(-3 * PASSED)
DRIFTING = levels() + 0.02 * drawn(FRAMES, seed=9)
NOTHING = Model()


@pytest.fixture(scope="module")
def cooling():
    return fit_to(COOLING)


def looked(fit, model):
    return SimpleNamespace(joint=(fit, model), obs=SimpleNamespace(why=""), certainty=Certainty(fit, model))


def test_folds_leave_out_every_observation_once_and_no_image_or_point_whole():
    fold = fold_of(8, 12)
    for k in range(FOLDS):
        out = fold == k
        assert out.sum() == out.numel() / FOLDS
        assert not out.all(0).any() and not out.all(1).any()


def test_what_is_there_gains_where_it_was_not_fitted_and_what_is_not_there_loses(cooling):
    model = Model.of(relaxation=1)
    gain = compared(squares_of(cooling, model), squares_of(cooling, NOTHING), cooling.weights)
    assert gain.db > 3 and gain.sigmas > MIN_SIGMAS and gain.images == FRAMES
    still = fit_to(levels())
    gain = compared(squares_of(still, model), squares_of(still, NOTHING), still.weights)
    assert gain.db < 0


@pytest.mark.parametrize("together", [True, False])
def test_shuffled_images_have_the_same_departures_in_another_order(cooling, together):
    other = shuffled(cooling, NOTHING, torch.Generator().manual_seed(1), together)
    before = (cooling.residuals(NOTHING) / cooling.errors)[cooling.weights > 0]
    left = (other.data.tracks.values - cooling.data.tracks.values + cooling.residuals(NOTHING)) / cooling.errors
    after = left[cooling.weights > 0]
    torch.testing.assert_close(after.sort().values, before.sort().values)
    assert (after - before).abs().max() > 1
    model = Model.of(relaxation=1)
    assert cooling.gain(model, NOTHING) > 3 * other.gain(model, NOTHING)


def test_points_are_shuffled_alike_or_each_in_its_own_order():
    fit = fit_to(DRIFTING)
    model, generator = Model.of(frame_offset=1), torch.Generator().manual_seed(2)
    alike, apart = (shuffled(fit, NOTHING, generator, together) for together in (True, False))
    assert alike.gain(model, NOTHING) > 0.8 * fit.gain(model, NOTHING)
    assert apart.gain(model, NOTHING) < 0.1 * fit.gain(model, NOTHING)


def test_a_clear_effect_is_told_and_one_of_chance_is_not(cooling):
    model = Model.of(relaxation=1)
    evidence = gained(looked(cooling, model), "relaxation", "points change by")
    assert evidence.told and evidence.gain_db > MIN_DB and evidence.statistic > 2.5
    still = fit_to(levels())
    chance = gained(looked(still, model), "relaxation", "points change by")
    assert not chance.told and "cannot be told" in chance.reason


def test_a_lamp_that_few_frames_cannot_follow_is_not_taken_for_the_camera():
    """Half of the points are lit: what images have in common is not common to all."""
    lit = (torch.arange(POINTS) % 2 == 0)[:, None]
    fit = fit_to(levels() + 0.05 * lit * drawn(FRAMES, seed=9))
    certainty = Certainty(fit, Model.of(frame_offset=1))
    assert "not common to all points" in certainty.doubts["frame_offset"]
    assert {"relaxation", "harmonic_source"} <= set(certainty.doubts)
    assert not Certainty(fit_to(DRIFTING), Model.of(frame_offset=1)).doubts


def test_too_few_frames_are_told_with_how_many_are_needed():
    data = data_of(COOLING + 0.05 * drawn(POINTS, 1, seed=10) * torch.sin(9 * PASSED))
    data.tracks.weights[:, ::4] = 0
    data.tracks.weights[:, 1::2] = 0
    fit = fit_of(data)
    assert data.usual_length == 7
    evidence = gained(looked(fit, NOTHING), "harmonic_source", "points change by")
    assert not evidence.told and evidence.statistic is None
    assert evidence.reason == "cannot be told: of 30 frames 7 see a point, and 13 are needed"


def test_frames_that_are_explained_leave_nothing_for_another_effect():
    data = data_of(levels())
    data.tracks.weights[:, 1::3] = 0
    data.tracks.weights[:, 2::3] = 0
    certainty = Certainty(fit_of(data), NOTHING)
    assert certainty.explained and not certainty.few("harmonic_source")
