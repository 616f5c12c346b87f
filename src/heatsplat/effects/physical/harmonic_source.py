"""Heat that is switched on and off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from heatsplat.effects import heat_source, weather_record
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.courses import common_courses
from heatsplat.effects.joint.data import MIN_FREE, Data
from heatsplat.effects.joint.evidence import gained, selected_kind
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.moments import share_of_points
from heatsplat.effects.joint.terms import OWN_HURDLE, Own, well_seen
from heatsplat.effects.physical import relaxation

# Courses over time that points share: one source and bodies that follow it more or less slowly need a few.
COURSES = (1, 2, 3)
HARMONIC, COMMON = "harmonics", "common"  # values of effects.source


def evidence(inspected: Inspection) -> Evidence:
    """Whether something drives the scene, and what says how."""
    driven, source = weather_record.drives(inspected.scene.weather), inspected.heat_source
    beside = "what the weather does" if driven else "any relaxation"
    if driven and source is None:
        return Evidence(0.0, "the recorded weather stands for what drives the scene")
    found = gained(inspected, heat_source.NAME, f"points depart from {beside} by")
    if source is None:
        return passing(inspected) or found
    settings = {"source": COMMON if source.common else HARMONIC, "frequencies": source.harmonics}
    if source.course is not None:
        settings["course"] = [round(power, 4) for power in source.course.tolist()]  # also for who asks for it by hand
    if not source.common:
        return replace(found, settings=settings)
    said = (
        f"{found.reason}; all points answer one course, which foresees images to {source.foreseen:.2g} times that error, "
        f"where harmonics of each point do to {source.foreseen_by_harmonics:.2g} times"
    )
    known = inspected.beside_source
    if known is None or not known.sure:
        return replace(found, reason=said, settings=settings)
    said += f"; surfaces that relax before a camera with an offset and a gain in each image foresee {known.gain.db:.1f} dB less"
    return replace(found, reason=said, settings=settings, gain_db=known.gain.db)


def passing(inspected: Inspection) -> Evidence | None:
    """Whether something hot passes points that cool otherwise; None where nothing does. Points then share no course over time,
    but each has a moment of its own, which takes all the harmonics there are."""
    if weather_record.drives(inspected.scene.weather) or not selected_kind(inspected, "relaxation"):
        return None
    times = share_of_points(*inspected.joint)
    if times <= EFFECT.threshold:
        return None
    said = (
        f"{times:.1f} times as many points as by chance change by much, all the same way, at moments of their own, as where "
        "something passes them"
    )
    return Evidence(times, said, settings={"source": HARMONIC, "frequencies": heat_source.HARMONICS[-1]})


def kinds(fit: Fit) -> Sequence[int]:
    """Numbers of common courses that the record has frames for."""
    return allowed(fit.data)


def allowed(data: Data) -> list[int]:
    if data.span_s <= 0:
        return []
    return [count for count in COURSES if count <= data.usual_length - 1 - relaxation.count(data) - MIN_FREE]


def rich(data: Data) -> int | None:
    return COURSES[0] if relaxation.rich(data) and COURSES[0] in allowed(data) else None


EFFECT = Effect(
    name=heat_source.NAME,
    stage="state",
    place=1,
    summary="heat sources that are switched on and off: one course that all points answer, or K harmonics of each",
    source="ETGS, Eq. 6-8; a common course: ours",
    needs=frozenset({"time"}),
    null="all changes are mixtures of relaxations",
    # Up to 1.3 without it, and 5.0 once, in haze; from 3.4 with it. Of points that something passes: up to 1.9 and from 5.3.
    threshold=OWN_HURDLE,
    adds="2 K amplitudes for each Gaussian, 11 K operations; a common course: 6 numbers in place of all, 6 operations",
    evidence=evidence,
    part=Part(
        "state", "newton_harmonic", {"frequencies": 0}, "source", {HARMONIC: "newton_harmonic", COMMON: "common_source"}
    ),
    term=Own(
        # By which they depart from relaxation.
        basis=lambda fit, count: common_courses(fit, Model.of(relaxation=1), count),
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
