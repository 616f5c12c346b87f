"""Surroundings seen as in a mirror."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.evidence import gained
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.terms import SHARED_HURDLE, Shared
from heatsplat.geometry.rotations import reflected


def evidence(inspected: Inspection) -> Evidence:
    """Whether one map of the surroundings, mirrored in the surfaces, explains a part of the images."""
    return gained(inspected, "reflection", "mirrored surroundings add")


def columns(data: Data, image: Tensor, known: Mapping[str, Tensor]) -> Columns:
    """Harmonics to degree 2 of the direction that a mirror shows."""
    x, y, z = reflected(-data.tracks.directions, data.normals[:, None]).unbind(2)
    return Columns.dense(torch.stack([x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], 2))


def kinds(fit: Fit) -> Sequence[object]:
    return (1,) if fit.data.moves and fit.data.normals is not None else ()


EFFECT = Effect(
    name="reflection",
    stage="emission",
    place=2,
    summary="mirror reflection of the surroundings",
    source="RaViGS, Eq. 5",
    null="view dependence does not follow the reflected ray",
    # Up to 1.0 without it, from 10 with it.
    threshold=SHARED_HURDLE,
    adds="a reflectivity for each Gaussian, one map of the surroundings",
    evidence=evidence,
    part=Part("path", "reflection"),
    term=Shared(
        columns=columns,
        order=0,
        kinds=kinds,
        numbers=lambda data, kind: 8,
        unseen=lambda data: "the points show no surface",
        rivals=(("directional_emissivity",),),
        smallest=0.2,  # misplaced points go with direction a little
        beside_changes=0.04,
    ),
)
