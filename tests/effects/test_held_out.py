"""What effects gain where they were not fitted, and what shuffled images make of them."""

import pytest
import torch
from effects.tracks import COOLING, DRIFTING, FRAMES, NOTHING, fit_to, levels

from heatsplat.effects.joint.certainty import MIN_SIGMAS
from heatsplat.effects.joint.held_out import FOLDS, HeldOut, compared, fold_of, shuffled, squares_of, would_tell
from heatsplat.effects.joint.model import Model


@pytest.fixture(scope="module")
def cooling():
    return fit_to(COOLING)


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


def test_frames_are_asked_for_only_where_they_would_be_looked_at():
    """Twice the standard errors take four times the frames; of a recording of any length 64 are looked at."""
    assert would_tell(HeldOut(1.0, 2.0, 15), 4.0) == "about 60 frames would tell"
    for gain in (HeldOut(1.0, 2.0, 17), HeldOut(1.0, 2.0, 64), HeldOut(1.0, -3.0, 5)):
        assert would_tell(gain, 4.0) == "less noise would tell, for no more than 64 frames are looked at"


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
