"""A bent curve from heat to grey."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.certainty import Certainty
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.evidence import gained
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.held_out import shows
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.selection import worthwhile
from heatsplat.effects.joint.terms import SHARED_HURDLE, Shared
from heatsplat.effects.physical import frame_offset


def evidence(inspected: Inspection) -> Evidence:
    """Whether what moves a whole image moves its dark and bright parts by amounts that a bent curve explains.

    A curve that never changes over a scene that never changes only renames its levels: nothing shows it, and nothing is
    lost without it. It shows where an offset moves all levels along it.
    """
    found = gained(inspected, "tone", "offsets act on dark and bright parts differently by")
    on = found.statistic is not None and found.statistic > EFFECT.threshold
    if on or not found.told or inspected.joint is None or frame_offset.evidence(inspected).told:
        return found
    if _may_bend(inspected.certainty):
        why = "nobody can tell whether offsets move the levels along a curve"
        return Evidence(None, f"cannot be told: {why}", told=False)
    return found


def _may_bend(certainty: Certainty) -> bool:
    """Whether a curve explains anything, of what it was not fitted to as well, if offsets move the levels along it.

    If it does not it is absent: nothing shows a curve without offsets, and nothing is lost without it. Heat that nobody can tell
    takes the offsets along, and the curve with them. It is therefore asked beside what would explain the images as well as that
    heat does: a camera with an offset and a gain of its own in each image.
    """
    fit, model = certainty.fit, certainty.model
    heat = [name for name in model.names if fit.data.effects[name].term.in_time and name in certainty.doubts]
    drifting = model.minus(heat).plus("frame_offset")
    drifting = drifting.plus("agc") if heat else drifting
    at = fit.accepted(drifting).accepted(drifting) if heat else fit.linearised(drifting)
    bent = drifting.plus("tone")
    if at.gain(bent, drifting) <= 1.0 or not worthwhile(at, bent, drifting, "tone"):
        return False
    return shows(Certainty(at, drifting).compared(bent, drifting))


def columns(data: Data, image: Tensor, known: Mapping[str, Tensor]) -> Columns:
    """A curve T turns an offset o of the level x into T'(x) o: what it bends goes with o times x and x²."""
    offset = known.get("frame_offset", torch.zeros_like(image))[..., None]
    return Columns.dense(torch.cat([offset * image[..., None], offset * image[..., None] ** 2], 2))


def kinds(fit: Fit) -> Sequence[object]:
    return (1,) if "frame_offset" in fit.known else ()


EFFECT = Effect(
    name="tone",
    stage="sensor",
    place=7,
    summary="nonlinear response from radiation to grey value",
    source="SupIR-GS, Eq. 7, 8",
    null="a change common to an image is linear in its grey values",
    # Up to 0.4 without it, from 190 with it.
    threshold=SHARED_HURDLE,
    adds="a small network of one variable, stored as 256 levels",
    evidence=evidence,
    part=Part("camera", "tone"),
    term=Shared(
        columns=columns,
        order=5,
        kinds=kinds,
        numbers=lambda data, kind: 2,
        unseen=lambda data: "no offset moves the levels along a curve",
        # Along a curve every offset comes with a gain: gains alone would be found first.
        starts=lambda data: (Model.of(frame_offset=1, tone=1),),
        sensor_first=True,
        beside_changes=0.01,
    ),
)
