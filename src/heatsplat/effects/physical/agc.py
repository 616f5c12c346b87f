"""Contrast that the camera stretches from image to image."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from torch import Tensor

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.evidence import gained, outdone
from heatsplat.effects.joint.terms import SHARED_HURDLE, Shared, centred
from heatsplat.effects.physical.frame_offset import NOT_COMMON, common_to_all, in_common


def evidence(inspected: Inspection) -> Evidence:
    """Whether each image has a gain of its own; beside a bent curve it only makes up for how that one is bent.

    Contrast outdoors swings with the sun, and gains that follow it take up what balances of heat leave out: while it cannot be
    told whether they are there, images of another day are foreseen better without (docs/effects.md).
    """
    if outdone(inspected, "agc", {"frame_offset", "tone"}):
        found = "what looks like gains of single images is a bent curve along which they shift"
        doubts = inspected.certainty.doubts
        doubt = doubts.get("agc") or doubts.get("tone")
        return Evidence(None, f"{found}, if it is: {doubt}", told=False) if doubt else Evidence(0.0, found)
    found = gained(inspected, "agc", "gains of single images change values by")
    if found.told or inspected.weathered is None:
        return found
    return replace(found, reason=f"{found.reason}; left out beside recorded weather", gain_db=None)


def columns(data: Data, image: Tensor, known: Mapping[str, Tensor]) -> Columns:
    """A gain for each frame."""
    return Columns.of_images(image)


EFFECT = Effect(
    name="agc",
    stage="sensor",
    place=6,
    summary="automatic gain control: contrast changes from image to image",
    source="SupIR-GS, Eq. 5",
    null="all images have the same gain",
    # Up to 0.7 without it, from 1.6 with it.
    threshold=SHARED_HURDLE,
    adds="a stretch and a shift for each training image, a logit and a sigmoid",
    evidence=evidence,
    part=Part("camera", "agc"),
    term=Shared(
        columns=columns,
        order=3,
        settled=centred,
        gain=True,
        kinds=lambda fit: (1,),
        numbers=lambda data, kind: data.frames - 1,
        single_images=True,
        rivals=(("frame_offset", "tone"), ("attenuation",), ("frame_offset", "attenuation")),
        told_by=((common_to_all, NOT_COMMON),),
        rich=lambda data: 1,
        beside_changes=0.1,
        rules=(in_common,),
    ),
)
