"""Heat goes on between images: whether courses over time foresee images that are left out whole."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import replace

import torch
from torch import Tensor

from heatsplat.effects.joint.courses import common_courses
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.held_out import WORST, HeldOut, compared, shows
from heatsplat.effects.joint.least_squares import own_part
from heatsplat.effects.joint.model import Model
from heatsplat.training.rng import generator_for

FOLDS = 4  # of the images: each is foreseen from the others
COURSES = (1, 2)  # that points have in common, each in its own measure
DECAY, CYCLES = 3.0, 2.0  # per record, of a scene that cools and of one that a lamp heats and lets go


def foreseen(fit: Fit, values: Tensor, count: int) -> HeldOut:
    """What courses over time, of which each point has its own measure, gain over levels where images are left out whole.

    A camera may jump from image to image; surfaces go on between them. In an image that is left out a course is on the line
    between its neighbours in time.

    Args:
        fit: that says what each of the values counts.
        values: [P, F].
        count: how many courses.
    """
    return compared(_squares(fit, values, count), _squares(fit, values, 0), fit.weights)


def holds_still(fit: Fit, model: Model, doubts: Collection[str]) -> bool:
    """Whether no course over time foresees images, though one as large as the error expected of an observation would.

    Of images without times, or of one moment, none lies between others, and nobody can say so.

    Args:
        fit: linearised about the model.
        model: of what images show.
        doubts: effects by name that may not be there; what they explain is left to the courses.
    """
    if not fit.data.span_s:
        return False
    added = fit.contributions(model)
    values = fit.data.tracks.values - sum(part for name, part in added.items() if name not in doubts)
    if _goes_on(fit, values):
        return False
    passed = fit.data.passed
    measures = torch.randn(2, len(values), 1, generator=generator_for(0, 0, "heat"), dtype=torch.float64)
    courses = torch.exp(-DECAY * passed), torch.cos(2.0 * math.pi * CYCLES * passed)
    expected = fit.errors * fit.trust.sqrt()[:, None]
    heat = [
        measure * (course - course.mean()) / course.std() for measure, course in zip(measures, courses, strict=True)
    ]
    return all(_goes_on(fit, values + one * expected) for one in heat)


def _goes_on(fit: Fit, values: Tensor) -> bool:
    return any(shows(foreseen(fit, values, count)) for count in COURSES)


def _squares(fit: Fit, values: Tensor, count: int) -> Tensor:
    """Squared errors [P, F] of so many common courses at images that they were not fitted to, in squares of those expected."""
    points, frames = values.shape
    fold, squares = torch.arange(frames) % FOLDS, torch.zeros_like(values)
    tracks = replace(fit.data.tracks, values=values)
    for k in range(FOLDS):
        kept = fold != k
        seen = replace(fit, data=replace(fit.data, tracks=tracks), weights=fit.weights * kept, known={}, bases={})
        basis = torch.ones(frames, 1, dtype=values.dtype)
        if count:
            courses = common_courses(seen, Model(), count)
            basis = torch.cat([basis, torch.where(kept[:, None], courses, _between(courses, fit.data.passed, kept))], 1)
        left = (values - own_part(basis.expand(points, -1, -1), values, seen.weights)) / fit.errors
        squares = torch.where(fold == k, left**2 / fit.trust[:, None], squares)
    return squares.clamp(max=WORST)


def _between(courses: Tensor, passed: Tensor, kept: Tensor) -> Tensor:
    """Courses [F, k] at all times [F], from those of the images that are kept [F]; beyond the last the last goes on."""
    order = passed[kept].argsort()
    times, known = passed[kept][order], courses[kept][order]
    after = torch.searchsorted(times, passed).clamp(1, len(times) - 1)
    share = (passed - times[after - 1]) / (times[after] - times[after - 1]).clamp_min(1e-12)
    return torch.lerp(known[after - 1], known[after], share.clamp(0.0, 1.0)[:, None])
