"""Courses over time that points have in common, each in its own measure."""

import pytest
import torch
from effects.tracks import FRAMES, NOTHING, PASSED, POINTS, drawn, fit_to, levels

from heatsplat.effects.joint.courses import common_courses
from heatsplat.effects.joint.model import Model

LAMP = torch.sin(9 * PASSED)


def explained(courses, truth):
    """Share of the variance of a course [F] that courses [F, k] and a level explain."""
    basis = torch.cat([courses, torch.ones(FRAMES, 1, dtype=courses.dtype)], 1)
    left = truth - basis @ torch.linalg.lstsq(basis, truth[:, None]).solution[:, 0]
    return 1.0 - float(left.var() / truth.var())


def test_the_course_that_points_follow_in_their_own_measure_is_found():
    fit = fit_to(levels() + 0.1 * drawn(POINTS, 1, seed=8) * LAMP)
    assert explained(common_courses(fit, NOTHING, 1), LAMP) > 0.99


def test_two_courses_are_found_where_there_are_two():
    decay = torch.exp(-3 * PASSED)
    values = levels() + 0.1 * drawn(POINTS, 1, seed=8) * LAMP + 0.1 * drawn(POINTS, 1, seed=9) * decay
    courses = common_courses(fit_to(values), NOTHING, 2)
    assert min(explained(courses, LAMP), explained(courses, decay)) > 0.98
    assert courses.T @ courses == pytest.approx(torch.eye(2, dtype=torch.float64), abs=1e-9)


def test_what_another_effect_explains_is_no_course():
    """A lamp is found beside the cooling that the model has already."""
    values = levels() + 0.3 * drawn(POINTS, 1, seed=8) * torch.exp(-3 * PASSED) + 0.05 * drawn(POINTS, 1, seed=9) * LAMP
    fit = fit_to(values)
    beside, alone = (common_courses(fit, model, 1) for model in (Model.of(relaxation=1), NOTHING))
    decays = fit.basis("relaxation", 1)
    assert explained(torch.cat([beside, decays], 1), LAMP) > 0.95 > explained(alone, LAMP)
