"""What drives a scene, and which patterns of a camera show beside it."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.effects import heat_source
from heatsplat.effects.heat_source import KNOWN, NAME, PATTERNS, Source
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.certainty import Certainty
from heatsplat.effects.joint.evidence import judged
from heatsplat.effects.joint.fit import fit_of
from heatsplat.effects.joint.held_out import HeldOut
from heatsplat.effects.joint.model import Model
from heatsplat.effects.physical import fixed_pattern, harmonic_source, relaxation, vignetting
from tests.effects.tracks import FRAMES, TIMES_S, data_of, drawn, levels

EFFECTS = [one.EFFECT for one in (relaxation, harmonic_source, fixed_pattern, vignetting)]


def inspected(name: str, frames: int) -> Inspection:
    scene = Synthetic(scene=name, size="tiny", frames=frames).scene
    return Inspection(replace(scene, points=scene.points[::2], point_colors=scene.point_colors[::2]), EFFECTS)


@pytest.fixture(scope="module")
def even():
    return inspected("heated", 24)


@pytest.fixture(scope="module")
def uneven():
    return inspected("uneven_heated", 36)  # fewer cannot tell its pattern


def test_beside_the_course_of_a_lamp_a_pattern_is_told_that_any_course_may_take_for_heat(uneven):
    assert uneven.heat_source.common
    assert not fixed_pattern.evidence(_without_a_course(uneven)).told
    pattern, falloff = fixed_pattern.evidence(uneven), vignetting.evidence(uneven)
    assert pattern.told and pattern.statistic > fixed_pattern.EFFECT.threshold and pattern.gain_db > 1
    assert falloff.told and falloff.statistic > vignetting.EFFECT.threshold


def _without_a_course(found: Inspection) -> Inspection:
    """The same inspection by the joint fit alone."""
    alone = Inspection(found.given, found.effects)
    alone.joint, alone.for_patterns = found.joint, found.certainty
    return alone


def test_the_known_course_takes_the_place_of_relaxation_and_of_any_courses(uneven):
    beside = uneven.for_patterns
    assert beside is not uneven.certainty
    assert beside.model.kind(NAME) == KNOWN and not beside.model.names & {"relaxation", *PATTERNS}
    # A decay and an answer for each rate, of which the answers rise and fall with the source.
    basis = beside.fit.basis(NAME, KNOWN)
    rates = len(heat_source.RATES)
    assert basis.shape == (len(uneven.obs.times_s), 2 * rates)
    assert (basis[0, :rates] == 1.0).all() and (basis[1:, :rates].diff(dim=0) < 0).all()
    assert not uneven.certainty.doubts.keys() & beside.model.names - {NAME}


def test_before_an_even_camera_and_without_a_common_source_the_joint_fit_says_what_there_is(even, uneven):
    assert even.heat_source.common and even.for_patterns is even.certainty
    none = Inspection(uneven.given, uneven.effects)
    none.joint, none.heat_source = uneven.joint, Source(uneven.heat_source.harmonics)
    assert none.for_patterns is none.certainty
    for effect in (fixed_pattern, vignetting):
        assert effect.evidence(even).statistic == 0.0


def test_a_lamp_that_no_camera_explains_as_well_is_certain_with_what_stands_on_it(even):
    known = even.beside_source
    assert known.sure and not known.uneven and known.gain.db > 1
    assert not even.certainty.doubts.keys() & {NAME, "relaxation"}
    found = harmonic_source.evidence(even)
    assert found.told and found.gain_db == known.gain.db and "an offset and a gain in each image" in found.reason
    assert relaxation.evidence(even).told


@pytest.mark.parametrize(("db", "sure", "doubted"), [(1.0, True, False), (0.2, False, None), (-0.2, False, True)])
def test_a_camera_that_explains_images_better_leaves_the_source_in_doubt(even, db, sure, doubted):
    known = replace(even.beside_source, gain=HeldOut(db, 5.0, 36), sure=sure, relaxes=False)
    if doubted is None:
        assert known.told == {}
        return
    certainty = Certainty(*even.joint, known.told)
    assert all(bool(certainty.doubts.get(name)) == doubted for name in (NAME, "relaxation"))
    fit, model = certainty.fit, certainty.model
    found = judged(certainty, NAME, "", model, fit.without(model, NAME))
    assert found.told != doubted and (heat_source.CAMERA in found.reason) == doubted


def test_one_course_is_common_where_it_foresees_images_at_least_as_well_as_harmonics():
    course = torch.ones(3)
    assert not Source(4).common
    assert [Source(4, course, one, 1.0).common for one in (0.9, 1.0, 1.1)] == [True, True, False]


def test_points_that_depart_from_every_course_share_none(even, monkeypatch):
    monkeypatch.setattr(heat_source, "common_course", lambda values, *_, **__: (torch.ones(64), 10 * values))
    found = heat_source.source(even, 1)
    assert len(found.course) == 64 and not found.common


def test_what_is_foreseen_comes_from_other_images_and_counts_in_errors():
    """Each image from the mean of the other folds: 1 in the one that is 1, 1/3 in the others."""
    values = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).repeat(3, 5)
    weights = torch.full_like(values, 0.25)  # errors of 2
    mean = lambda known: ((known * values).sum(1) / known.sum(1))[:, None].expand_as(values)  # noqa: E731
    found = heat_source._foreseen(values, weights, mean)
    assert found == pytest.approx((1.0 + 3 * (1 / 3)) / 4 / 2)
    weights[:, 7] = 0.0  # not seen
    values[:, 7] = 1e9
    assert heat_source._foreseen(values, weights, mean) == pytest.approx(found, rel=0.2)
    assert heat_source._foreseen(1e6 * values, weights, mean) <= heat_source.FARTHEST


def test_surfaces_that_relax_before_any_camera_are_certain_whatever_drives_them(even):
    assert even.beside_source.relaxes
    known = replace(even.beside_source, gain=HeldOut(-0.2, 5.0, 36), sure=False)
    doubts = Certainty(*even.joint, known.told).doubts
    assert doubts[NAME] == heat_source.CAMERA and "relaxation" not in doubts


def test_levels_before_a_camera_that_jumps_do_not_relax():
    jumping = 0.5 + (levels() - 0.5) * (1.0 + 0.1 * drawn(FRAMES, seed=9))
    fit = fit_of(replace(data_of(jumping), ambient=0.0))
    seen = SimpleNamespace(
        joint=(fit, Model.of(relaxation=1, harmonic_source=1)),
        obs=SimpleNamespace(times_s=TIMES_S),
        scene=SimpleNamespace(record=(0.0, float(TIMES_S[-1]))),
    )
    assert not heat_source.beside(seen, torch.ones(64, dtype=torch.float64)).relaxes
