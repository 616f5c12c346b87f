"""What drives a scene: one source that all points answer, or harmonics of each; and what else images show beside it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from heatsplat.effects.joint.certainty import MIN_DB, MIN_SIGMAS, Certainty
from heatsplat.effects.joint.courses import DECAYS_FEW
from heatsplat.effects.joint.data import MIN_FREE
from heatsplat.effects.joint.held_out import HeldOut
from heatsplat.effects.joint.terms import Own, Path
from heatsplat.physics.common_course import RATES, common_course, least_squares, response
from heatsplat.physics.frequencies import default_tau_min, frequency_grid

if TYPE_CHECKING:
    from heatsplat.effects.inspection import Inspection

NAME = "harmonic_source"  # of the effect
KNOWN = "known"  # its kind in the joint fit where the course of the source is known
DRIVEN = (NAME, "relaxation")  # what is certain, or in doubt, with a source
CAMERA = "a camera with an offset and a gain of its own in each image would explain the images as well; more frames would tell"
PATTERNS = ("fixed_pattern", "vignetting")  # what a camera adds at places in the image, whatever drives the scene
# On held-out observations, beside a known course, where a lamp stands before an uneven camera: 5.1 to 6.2 with 63 images, 2.4
# with 31, and 0.7 to 1.6 with 16; 0.0 before an even one, and 0.9 where a gain control passes for the lamp.
LEAST_DB = 2.0
FOLDS = 4  # of the images: each is foreseen from the others
FARTHEST = 30.0  # errors expected, beyond which it does not matter how wrong a value is foreseen
HARMONIC_RIDGE = 1e-5  # with which harmonics of points foresee best
HARMONICS = (1, 2, 3, 4, 6, 8, 12, 16, 24)
RATES_OF_POINTS = torch.tensor(RATES, dtype=torch.float64)


@dataclass(frozen=True, eq=False)
class Source:
    """What drives a scene.

    Attributes:
        harmonics: how many of each point say how it goes.
        course: power of one source that all points answer (``physics.common_course``); None where nobody can tell.
        foreseen: mean size of the errors at images that the course was not fitted to, in units of those expected.
        foreseen_by_harmonics: the same of a few harmonics of each point.
    """

    harmonics: int
    course: Tensor | None = None
    foreseen: float = math.inf
    foreseen_by_harmonics: float = math.inf

    @property
    def common(self) -> bool:
        """Whether one course for all points foresees images better than harmonics of each."""
        return self.course is not None and self.foreseen <= self.foreseen_by_harmonics


def source(inspected: Inspection, count: int) -> Source:
    """What drives a scene whose points share ``count`` courses over time beside any relaxation."""
    found = Source(harmonics(inspected, count))
    seen = answering(inspected)
    if seen is None:
        return found
    values, weights, _ = seen
    times = spans(inspected)
    phases = (inspected.obs.times_s - inspected.scene.record[0])[:, None] * frequencies(inspected, found.harmonics)
    basis = torch.cat([torch.exp(-times[:, None] * RATES_OF_POINTS), phases.cos(), phases.sin()], 1)
    course, _ = common_course(values, weights, times)

    def answered(known: Tensor) -> Tensor:
        return torch.where(known > 0, values, 0.0) - common_course(values, known, times, start=course)[1]

    return replace(
        found,
        course=course,
        foreseen=_foreseen(values, weights, answered),
        foreseen_by_harmonics=_foreseen(
            values, weights, lambda known: least_squares(values, known, basis, HARMONIC_RIDGE)[0] @ basis.T
        ),
    )


def answering(inspected: Inspection) -> tuple[Tensor, Tensor, Tensor] | None:
    """Of the points that are seen often enough to say how they answer a source, without what the camera adds: excess over the
    surroundings [P, F], 0 where it was not seen, weights [P, F], and places [P, 3]. None where there are none, where nobody
    knows the surroundings, and where a path takes away some of it."""
    fit, model = inspected.joint
    data = fit.data
    if data.ambient is None or fit.terms(model, Path):
        return None
    values = data.tracks.values - sum(fit.contributions(model).values()) - data.ambient
    counted = (fit.weights > 0).sum(1) >= 2 * len(RATES) + MIN_FREE
    if not counted.any():
        return None
    weights = fit.weights[counted]
    return torch.where(weights > 0, values[counted], 0.0), weights, data.tracks.points[counted]


@dataclass(frozen=True, eq=False)
class Known:
    """What images show where points answer a source whose course is known.

    The joint fit knows no physics of sources: the courses that it gives points, each in its own measure, are any that explain
    most. They are hard to tell from what a camera does to single images; and as points move through the image while time goes
    by, they take a pattern of the camera for heat. What surfaces can answer to a known course does neither.

    Attributes:
        certainty: of the fit beside that source, with the patterns where images are uneven.
        uneven: whether a camera's patterns are clearly there.
        gain: over surfaces that relax before a camera with an offset and a gain of its own in each image, where left out.
        sure: whether that is clear, as what it gains over air that takes a share of its own from each image.
        relaxes: whether surfaces clearly do before such a camera, and behind such air, whatever drives them.
    """

    certainty: Certainty
    uneven: bool
    gain: HeldOut
    sure: bool
    relaxes: bool

    @property
    def told(self) -> dict[str, str]:
        """What it says of the effects of a driven scene (``Certainty``)."""
        if self.sure:
            return dict.fromkeys(DRIVEN, "")
        told = dict.fromkeys(DRIVEN, CAMERA) if self.gain.db < 0 else {}
        return told | {"relaxation": ""} if self.relaxes else told


def beside(inspected: Inspection, course: Tensor) -> Known:
    """What images show beside a source whose power over the record is ``course`` [K] (``physics.common_course``)."""
    fit, model = inspected.joint
    basis = torch.cat(response(course, spans(inspected), RATES_OF_POINTS), 1)
    effect = replace(
        fit.data.effects[NAME],
        term=Own(basis=lambda at, kind: basis, kinds=lambda at: (KNOWN,), in_time=True),
        stands_on=None,
    )
    even = model.minus({*DRIVEN, *PATTERNS}).plus(NAME, KNOWN)
    uneven = even.plus(PATTERNS[0]).plus(PATTERNS[1])
    fit = replace(fit, data=replace(fit.data, effects={**fit.data.effects, NAME: effect}), known={}, bases={})
    # Twice: the first time, what multiplies an image is not yet linearised about one without the pattern.
    certainty = Certainty(fit.accepted(uneven).accepted(uneven), even)
    gain = certainty.compared(uneven, even)
    shows = gain.exceeds(LEAST_DB, MIN_SIGMAS)
    driven = uneven if shows else even
    still = driven.minus({NAME})
    camera, air = still.plus("frame_offset").plus("agc"), still.plus("attenuation", "varying")
    gain = certainty.compared(driven, camera.plus("relaxation"))
    sure = _clear(gain) and _clear(certainty.compared(driven, air))
    relaxes = all(_clear(certainty.compared(one.plus("relaxation"), one)) for one in (camera, air))
    return Known(certainty, shows, gain, sure, relaxes)


def _clear(gain: HeldOut) -> bool:
    return gain.exceeds(MIN_DB, MIN_SIGMAS)


def harmonics(inspected: Inspection, count: int) -> int:
    """K for which the criterion is least when the courses that points share are written as K harmonics and a decay.

    The grid of frequencies is that of the thermal model, whose response to a harmonic after its start is that harmonic
    and a decay.
    """
    fit, _ = inspected.joint
    shared = fit.basis(NAME, count)
    frames = len(shared)
    passed = inspected.obs.times_s - inspected.obs.times_s.min()
    decays = torch.exp(-passed[:, None] / float(passed.max()) * torch.tensor(DECAYS_FEW, dtype=torch.float64))
    used = (fit.weights > 0).sum(0).double()
    # A course is known as well as the mean over the points that show it; the noise of one point is the criterion's own.
    best, least = 1, math.inf
    for number in HARMONICS:
        omega = frequencies(inspected, number)
        phases = passed[:, None] * omega
        basis = torch.cat([torch.ones(frames, 1, dtype=torch.float64), decays, phases.cos(), phases.sin()], 1)
        if basis.shape[1] > frames - 2:
            break
        left = shared - basis @ torch.linalg.lstsq(basis, shared).solution
        variance = max(float((left**2).sum()) / (count * (frames - basis.shape[1])), 1e-12)
        criterion = frames * count * math.log(variance) + 2 * len(omega) * count * math.log(float(used.mean()))
        if criterion < least:
            best, least = number, criterion
    return best


def frequencies(inspected: Inspection, count: int) -> Tensor:
    """Of the thermal model's grid, in radians per second."""
    recorded = torch.tensor([t for t in inspected.scene.train.times_s if t is not None], dtype=torch.float64)
    return frequency_grid(recorded, count, default_tau_min(recorded), math.sqrt(0.5))


def spans(inspected: Inspection) -> Tensor:
    """When images were taken, in spans of the record."""
    first, span = inspected.scene.record
    return (inspected.obs.times_s - first) / span


def _foreseen(values: Tensor, weights: Tensor, explained: Callable[[Tensor], Tensor]) -> float:
    """Mean size of the errors, in units of those expected, of values [P, F] that are foreseen from other images."""
    fold, errors = torch.arange(values.shape[1]) % FOLDS, []
    for k in range(FOLDS):
        left = (values - explained(weights * (fold != k))) * weights.sqrt()
        errors.append(left[(weights > 0) & (fold == k)].abs().clamp_max(FARTHEST))
    return float(torch.cat(errors).mean())
