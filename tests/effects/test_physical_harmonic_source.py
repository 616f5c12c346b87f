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
    scene = Synthetic(scene=name, **recorded).scene
    scene = replace(scene, points=scene.points[::2], point_colors=scene.point_colors[::2])
    return Inspection(scene, [relaxation.EFFECT, harmonic_source.EFFECT])


@pytest.fixture(scope="module")
def heated():
    return inspected("heated", size="tiny", frames=24)


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


def test_where_harmonics_of_each_point_foresee_better_they_are_taken(heated):
    source = heated.heat_source
    assert source.common
    told = {}
    for name, foreseen in (("harmonics", 1.1), ("common", 0.9)):
        told[name] = Inspection(heated.given, heated.effects)
        told[name].joint, told[name].heat_source = (
            heated.joint,
            replace(source, foreseen=foreseen, foreseen_by_harmonics=1.0),
        )
        found = harmonic_source.evidence(told[name]).settings
        assert found["source"] == name and found["frequencies"] == source.harmonics and len(found["course"]) == MOMENTS


@pytest.mark.slow
def test_what_passes_points_one_after_the_other_gives_each_its_own():
    found = harmonic_source.evidence(inspected("moving_source", size="demo"))
    assert found.settings["source"] == "harmonics"
