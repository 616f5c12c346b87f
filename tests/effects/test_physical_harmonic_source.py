"""Whether points answer the course of one source, and which."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.physical import harmonic_source, relaxation
from heatsplat.physics.common_course import MOMENTS


def inspected(name, **recorded):
    return Inspection(Synthetic(scene=name, **recorded).scene, [relaxation.EFFECT, harmonic_source.EFFECT])


@pytest.fixture(scope="module")
def heated():
    return inspected("heated", size="tiny", frames=72)  # small images, as many as of a larger scene


def test_a_lamp_gives_all_points_one_course_which_is_its_own(heated):
    found = harmonic_source.evidence(heated)
    assert found.settings["source"] == "common" and "all points answer one course" in found.reason
    course = torch.tensor(found.settings["course"])
    assert len(course) == MOMENTS and course.abs().max() == 1.0
    first, span = heated.scene.record
    at = (first + span * np.linspace(0, 1, MOMENTS)) % 600.0
    lamp = torch.from_numpy(
        np.interp(at, [0, 120, 300, 420, 600], [0, 1, 1, 0, 0])
    ).float()  # on for half of ten minutes
    best = max(float(torch.corrcoef(torch.stack([course, torch.roll(lamp, shift)]))[0, 1]) for shift in range(-6, 7))
    assert best > 0.85


@pytest.mark.slow
def test_what_passes_points_one_after_the_other_gives_each_its_own():
    found = harmonic_source.evidence(inspected("moving_source", size="demo"))
    assert found.settings["source"] == "harmonics"


def test_points_that_depart_more_than_usual_share_no_course(heated, monkeypatch):
    monkeypatch.setattr(harmonic_source, "common_course", lambda values, *_, **__: (torch.ones(64), 10 * values))
    found = harmonic_source.evidence(heated).settings
    assert found["source"] == "harmonics" and len(found["course"]) == 64  # for who asks for it


def test_a_course_that_foresees_worse_than_harmonics_of_each_point_is_left(heated, monkeypatch):
    worse = replace(harmonic_source.shared(heated, 12), foreseen=1.1, foreseen_by_harmonics=1.0)
    monkeypatch.setattr(harmonic_source, "shared", lambda inspected, count: worse)
    assert harmonic_source.evidence(heated).settings["source"] == "harmonics"
    monkeypatch.setattr(harmonic_source, "shared", lambda inspected, count: replace(worse, foreseen=0.9))
    assert harmonic_source.evidence(heated).settings["source"] == "common"


def test_what_is_foreseen_comes_from_other_images_and_counts_in_errors():
    """Each image from the mean of the other folds: 1 in the one that is 1, 1/3 in the others."""
    values = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64).repeat(3, 5)
    weights = torch.full_like(values, 0.25)  # errors of 2
    mean = lambda known: ((known * values).sum(1) / known.sum(1))[:, None].expand_as(values)  # noqa: E731
    found = harmonic_source._foreseen(values, weights, mean)
    assert found == pytest.approx((1.0 + 3 * (1 / 3)) / 4 / 2)
    weights[:, 7] = 0.0  # not seen
    values[:, 7] = 1e9
    assert harmonic_source._foreseen(values, weights, mean) == pytest.approx(found, rel=0.2)
    assert harmonic_source._foreseen(1e6 * values, weights, mean) <= harmonic_source.FARTHEST
