"""Emission that depends on the direction of view."""

from __future__ import annotations

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.evidence import gained, outdone
from heatsplat.effects.joint.terms import OWN_HURDLE, Own, well_seen, where_moving


def evidence(inspected: Inspection) -> Evidence:
    """Whether points look different from different sides.

    Beside mirrors and emissivity that depends on direction it only makes up for their normals, which are known roughly.
    """
    if outdone(inspected, "view_dependence", {"reflection"}):
        return Evidence(0.0, "what depends on direction is mirrors, as far as their normals are known")
    taken = () if inspected.joint is None else inspected.joint[1].names
    if "directional_emissivity" in taken and "view_dependence" not in taken:
        return Evidence(0.0, "what depends on direction is emissivity, as far as normals are known")
    if "reflection" in taken and "view_dependence" not in taken:
        return Evidence(0.0, "what depends on direction is mirrors, as far as their normals are known")
    return gained(inspected, "view_dependence", "points change with the direction of view by")


EFFECT = Effect(
    name="view_dependence",
    stage="emission",
    place=1,
    summary="emission that depends on the direction of view",
    source="3DGS, spherical harmonics",
    null="a point looks the same from every direction",
    # Up to 1.7 without it; 4.7 where a falloff of emissivity, which is an effect of its own, is all that there is.
    threshold=OWN_HURDLE,
    adds="harmonics for each Gaussian",
    evidence=evidence,
    part=Part("path", "view_dependence"),
    term=Own(
        basis=lambda fit, kind: fit.data.tracks.directions,
        kinds=where_moving,
        frames=lambda data: well_seen(4),
        gives_way_to=("directional_emissivity", "reflection"),
    ),
)
