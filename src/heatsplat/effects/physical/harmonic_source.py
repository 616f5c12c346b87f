"""Heat that is switched on and off."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.courses import common_courses
from heatsplat.effects.joint.data import MIN_FREE, Data
from heatsplat.effects.joint.evidence import gained, selected_kind
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.moments import share_of_points
from heatsplat.effects.joint.terms import OWN_HURDLE, Own, Path, well_seen
from heatsplat.effects.physical import relaxation
from heatsplat.physics.common_course import RATES, common_course, least_squares
from heatsplat.physics.frequencies import default_tau_min, frequency_grid

# Courses over time that points share: one source and bodies that follow it more or less slowly need a few.
COURSES = (1, 2, 3)
HARMONIC, COMMON = "harmonics", "common"  # values of effects.source
FOLDS = 4  # of the images: each is foreseen from the others
FARTHEST = 30.0  # errors expected, beyond which it does not matter how wrong a value is foreseen
HARMONIC_RIDGE = 1e-5  # with which harmonics of points foresee best
HARMONICS = (1, 2, 3, 4, 6, 8, 12, 16, 24)


def evidence(inspected: Inspection) -> Evidence:
    """Whether something drives the scene, and how many harmonics say how."""
    beside = "any relaxation" if inspected.scene.weather is None else "what the weather does"
    if inspected.scene.weather is not None and not selected_kind(inspected, "harmonic_source"):
        return Evidence(0.0, "the recorded weather stands for what drives the scene")
    found = gained(inspected, "harmonic_source", f"points depart from {beside} by")
    count = selected_kind(inspected, "harmonic_source")
    if count is None:
        return passing(inspected) or found
    harmonic = {"source": HARMONIC, "frequencies": harmonics(inspected, count)}
    common = shared(inspected, harmonic["frequencies"])
    if common is None:
        return replace(found, settings=harmonic)
    harmonic["course"] = common.course  # for who asks for it
    if common.foreseen > common.foreseen_by_harmonics:
        return replace(found, settings=harmonic)
    said = (
        f"{found.reason}; all points answer one course, which foresees images to {common.foreseen:.2g} times that error, "
        f"where harmonics of each point do to {common.foreseen_by_harmonics:.2g} times"
    )
    return replace(found, reason=said, settings=harmonic | {"source": COMMON})


@dataclass(frozen=True)
class Shared:
    """A source that all points answer (``physics.common_course``), and how well it says what they do.

    Attributes:
        course: its power.
        foreseen: mean size of the errors at images that the course was not fitted to, in units of those expected.
        foreseen_by_harmonics: the same of a few harmonics of each point.
    """

    course: list[float]
    foreseen: float
    foreseen_by_harmonics: float


def shared(inspected: Inspection, count: int) -> Shared | None:
    """The source that all points answer beside ``count`` harmonics of each; None where nobody can tell."""
    fit, model = inspected.joint
    data, others = fit.data, fit.terms(model, Path)
    if data.ambient is None or others:
        return None
    first, span = inspected.scene.record
    added = sum(fit.contributions(model).values())
    values, weights = data.tracks.values - added - data.ambient, fit.weights
    own = 2 * len(RATES)
    counted = (weights > 0).sum(1) >= own + MIN_FREE
    if not counted.any():
        return None
    weights = weights[counted]
    values, spans = torch.where(weights > 0, values[counted], 0.0), (inspected.obs.times_s - first) / span
    phases = (inspected.obs.times_s - first)[:, None] * frequencies(inspected, count)
    decays = torch.exp(-spans[:, None] * torch.tensor(RATES, dtype=torch.float64))
    basis = torch.cat([decays, phases.cos(), phases.sin()], 1)
    course, _ = common_course(values, weights, spans)

    def answered(known: Tensor) -> Tensor:
        return torch.where(known > 0, values, 0.0) - common_course(values, known, spans, start=course)[1]

    return Shared(
        [round(power, 4) for power in course.tolist()],
        _foreseen(values, weights, answered),
        _foreseen(values, weights, lambda known: least_squares(values, known, basis, HARMONIC_RIDGE)[0] @ basis.T),
    )


def _foreseen(values: Tensor, weights: Tensor, explained: Callable[[Tensor], Tensor]) -> float:
    """Mean size of the errors, in units of those expected, of values [P, F] that are foreseen from other images."""
    fold, errors = torch.arange(values.shape[1]) % FOLDS, []
    for k in range(FOLDS):
        left = (values - explained(weights * (fold != k))) * weights.sqrt()
        errors.append(left[(weights > 0) & (fold == k)].abs().clamp_max(FARTHEST))
    return float(torch.cat(errors).mean())


def passing(inspected: Inspection) -> Evidence | None:
    """Whether something hot passes points that cool otherwise; None where nothing does. Points then share no course over time,
    but each has a moment of its own, which takes all the harmonics there are."""
    if inspected.scene.weather is not None or not selected_kind(inspected, "relaxation"):
        return None
    times = share_of_points(*inspected.joint)
    if times <= EFFECT.threshold:
        return None
    said = f"{times:.1f} times as many points as by chance change by much at moments of their own, as where something passes them"
    return Evidence(times, said, settings={"source": HARMONIC, "frequencies": HARMONICS[-1]})


def kinds(fit: Fit) -> Sequence[int]:
    """Numbers of common courses that the record has frames for."""
    return allowed(fit.data)


def allowed(data: Data) -> list[int]:
    if data.span_s <= 0:
        return []
    return [count for count in COURSES if count <= data.usual_length - 1 - relaxation.count(data) - MIN_FREE]


def rich(data: Data) -> int | None:
    return COURSES[0] if relaxation.rich(data) and COURSES[0] in allowed(data) else None


def harmonics(inspected: Inspection, count: int) -> int:
    """K for which the criterion is least when the courses that points share are written as K harmonics and a decay.

    The grid of frequencies is that of the thermal model, whose response to a harmonic after its start is that harmonic
    and a decay.
    """
    fit, _ = inspected.joint
    shared = fit.basis("harmonic_source", count)
    frames = len(shared)
    passed = inspected.obs.times_s - inspected.obs.times_s.min()
    decays = torch.exp(
        -passed[:, None] / float(passed.max()) * torch.tensor(relaxation.DECAYS_FEW, dtype=torch.float64)
    )
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


EFFECT = Effect(
    name="harmonic_source",
    stage="state",
    place=1,
    summary="heat sources that are switched on and off: one course that all points answer, or K harmonics of each",
    source="ETGS, Eq. 4, 7, 8; a common course: ours",
    needs=frozenset({"time"}),
    null="all changes are mixtures of relaxations",
    # Up to 1.3 without it, and 5.0 once, in haze; from 3.4 with it. Of points that something passes: up to 1.5 and from 5.0.
    threshold=OWN_HURDLE,
    adds="2 K amplitudes for each Gaussian, 11 K operations; a common course: 6 numbers in place of all, 6 operations",
    evidence=evidence,
    part=Part(
        "state", "newton_harmonic", {"frequencies": 0}, "source", {HARMONIC: "newton_harmonic", COMMON: "common_source"}
    ),
    term=Own(
        basis=lambda fit, count: common_courses(
            fit, Model.of(relaxation=1), count
        ),  # by which they depart from relaxation
        in_time=True,
        kinds=kinds,
        numbers=lambda data, count: count * data.frames,
        rich=rich,
        unseen=relaxation.unseen,
        rivals=(("attenuation",),),
        # Where the weather is recorded it stands for what drives a scene (``weather_record.INSTEAD``).
        frames=lambda data: well_seen(2 + relaxation.count(data)) if data.span_s > 0 and data.drivers is None else 0,
        beside_changes=0.15,
        rules=(relaxation.beyond_drift,),
    ),
    stands_on="relaxation",
)
