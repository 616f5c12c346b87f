"""Thermal lag of the detector's pixels."""

from __future__ import annotations

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.image_motion import WIDE_PX
from heatsplat.effects.inspection import Inspection

UNSEEN = "no point can be followed through images of a moving camera that have times"


def evidence(inspected: Inspection) -> Evidence:
    """Whether what points show trails behind the poses as the image moves.

    Poses that were found in the same images lag as they do, which leaves no more than a blur: this does not see it.
    """
    found = inspected.delays
    if found is None:
        return Evidence(None, inspected.obs.why or UNSEEN)
    late, error, trail = 1e3 * found.seconds[0].item(), 1e3 * found.errors[0].item(), found.pixels[0].item()
    why = f"images are {late:.2g} ± {error:.1g} ms late: {trail:.2g} pixels at the {found.fast_px_s:.3g} a second of fast ones"
    if not found.sure[0]:
        return Evidence(0.0, f"{why}, no more than chance, or no detector's")
    if trail < 0:
        return Evidence(0.0, f"{why}, which is no lag but clocks that disagree")
    return Evidence(trail / WIDE_PX, why)


EFFECT = Effect(
    name="thermal_lag",
    stage="sensor",
    place=1,
    summary="time constant of the detector's pixels",
    source="heat balance of a bolometer (Kruse, 2001)",
    needs=frozenset({"time"}),
    null="values do not lag behind the motion of the image",
    threshold=1.0,
    adds="a time constant and a time offset of the poses, and lookups along the image motion",
    evidence=evidence,
    part=Part("camera", "thermal_lag"),
)
