"""Points that change at moments of their own."""

import pytest
import torch
from effects.tracks import COOLING, FRAMES, PASSED, POINTS, drawn, fit_to, levels

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.effects.catalogue import CATALOGUE
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.moments import FADING, _changes, share_of_points
from heatsplat.effects.physical.harmonic_source import EFFECT

RELAXATION = Model.of(relaxation=1)


def passed_by(share, size=0.2):
    """What a hot thing adds to the first points, one after the other: each warms at once and cools in an eighth of the record."""
    begins = torch.linspace(0.2, 0.7, POINTS, dtype=torch.float64)[:, None]
    pulse = torch.where(begins < PASSED, (-8 * (PASSED - begins)).exp(), 0.0)
    return size * pulse * (torch.arange(POINTS) < share * POINTS)[:, None]


@pytest.mark.parametrize("share", [0.25, 0.5])
def test_points_that_something_passes_are_counted(share):
    found = share_of_points(fit_to(COOLING + passed_by(share)), RELAXATION)
    assert found == pytest.approx(42 * share, rel=0.15) and found > EFFECT.threshold


@pytest.mark.parametrize("values", [levels(), COOLING], ids=["at rest", "cooling"])
def test_points_that_nothing_passes_are_not(values):
    assert share_of_points(fit_to(values), RELAXATION) < 0.2 * EFFECT.threshold


def test_outliers_at_single_frames_are_no_more_than_chance_makes():
    """A point at an edge is off in single frames; these come in no order."""
    torn = 0.3 * drawn(POINTS, FRAMES, seed=3) * (drawn(POINTS, FRAMES, seed=4).abs() > 1.6)
    assert share_of_points(fit_to(COOLING + torn), RELAXATION) < EFFECT.threshold


def test_points_of_which_as_many_cool_as_warm_are_misplaced_ones():
    """What a misplaced point shows goes on from image to image where these follow each other closely: no shuffle does."""
    either = torch.where(torch.arange(POINTS) % 2 == 0, 1.0, -1.0)[:, None]
    assert share_of_points(fit_to(COOLING + either * passed_by(0.5)), RELAXATION) < 0.5 * EFFECT.threshold
    cold = share_of_points(fit_to(COOLING - passed_by(0.5)), RELAXATION)  # greys may be dark where it is hot
    assert cold == pytest.approx(42 * 0.5, rel=0.15)


@pytest.mark.slow
def test_a_film_of_a_scene_that_cools_shows_nothing_that_passes():
    cooling = Inspection(Synthetic(scene="cooling", size="tiny", frames=80).scene, CATALOGUE)
    assert "harmonic_source" not in cooling.joint[1].names
    assert share_of_points(*cooling.joint) < 0.5 * EFFECT.threshold


def test_changes_within_the_noise_do_not_count():
    assert share_of_points(fit_to(COOLING + passed_by(0.5, size=0.03)), RELAXATION) < 1.0


def test_a_driven_scene_needs_no_moments_where_its_model_knows_the_source():
    lamp = COOLING + 0.1 * drawn(POINTS, 1, seed=7).abs() * torch.sin(9 * PASSED)
    fit = fit_to(lamp)
    assert (
        share_of_points(fit, RELAXATION)
        > EFFECT.threshold
        > share_of_points(fit, RELAXATION.plus("harmonic_source", 1))
    )


def test_points_that_too_few_frames_see_say_nothing():
    values = COOLING + passed_by(0.5)
    fit = fit_to(values)
    fit.data.tracks.weights[:, 10:] = 0.0
    assert share_of_points(fit, RELAXATION) == 0.0


def test_each_change_begins_between_two_frames_and_fades():
    courses = _changes(PASSED)
    assert courses.shape == (FRAMES, len(FADING) * (FRAMES - 1))
    assert torch.equal((courses > 0).sum(0), torch.arange(FRAMES - 1, 0, -1).repeat(len(FADING)))
    assert bool((courses.max(0).values <= 1).all())
