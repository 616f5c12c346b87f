"""Whether points answer the course of one source, and which."""

import numpy as np
import pytest
import torch

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.effects.catalogue import CATALOGUE
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.physical import harmonic_source
from heatsplat.physics.common_course import MOMENTS


def inspected(name):
    return Inspection(Synthetic(scene=name, size="demo").scene, CATALOGUE)


@pytest.fixture(scope="module")
def heated():
    return inspected("heated")


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
    found = harmonic_source.evidence(inspected("moving_source"))
    assert found.settings["source"] == "harmonics"


def test_points_that_depart_more_than_usual_share_no_course(heated, monkeypatch):
    monkeypatch.setattr(harmonic_source, "common_course", lambda values, weights, spans: (torch.ones(64), 10 * values))
    found = harmonic_source.evidence(heated).settings
    assert found["source"] == "harmonics" and len(found["course"]) == 64  # for who asks for it
