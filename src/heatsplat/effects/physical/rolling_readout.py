"""Rows of the detector that are read one after the other."""

from __future__ import annotations

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.image_motion import WIDE_PX
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.physical.thermal_lag import UNSEEN


def evidence(inspected: Inspection) -> Evidence:
    """Whether what points show is of another moment the lower they are in the image."""
    found = inspected.delays
    if found is None:
        return Evidence(None, inspected.obs.why or UNSEEN)
    takes, error, shift = 1e3 * found.seconds[1].item(), 1e3 * found.errors[1].item(), abs(found.pixels[1].item())
    why = (
        f"the last row is read {takes:.2g} ± {error:.1g} ms after the first: both are off by {shift:.2g} pixels at the "
        f"{found.fast_px_s:.3g} a second of fast ones"
    )
    return (
        Evidence(shift / WIDE_PX, why)
        if found.sure[1]
        else Evidence(0.0, f"{why}, no more than chance, or no detector's")
    )


EFFECT = Effect(
    name="rolling_readout",
    stage="sensor",
    place=2,
    summary="rows are read one after the other",
    source="rolling shutter, pose of each row to first order",
    needs=frozenset({"time"}),
    null="all rows of an image have the same time",
    threshold=1.0,
    adds="one number, and lookups along the image motion",
    evidence=evidence,
    part=Part("camera", "rolling_readout"),
)
