"""Surfaces that emit less towards their sides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.evidence import gained, selected_kind
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.least_squares import own_part
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.terms import SHARED_HURDLE, Path

POWERS = (1, 5)  # of 1 - cos θ: of rough surfaces, and of smooth dielectrics (Schlick)
STEPS, CLOSE = 5, 1e-3  # of Gauss and Newton, and how small the last one is
LARGEST = 0.95  # share of its excess that a surface loses along itself, at most
CHANGED = 0.5  # share of the points, those that a falloff changes most, that have to show it
# Share of what harmonics explain at the usual one of them that a falloff has to explain: it does 0.42 and more where it stands
# out of the noise (25 recordings), and up to 0.29 where there is none (12, most of them blurred).
SHOWN = 0.33
MORE = "what points change with direction is mostly something else, as where blur takes contrast; sharper images would tell"


def evidence(inspected: Inspection) -> Evidence:
    """Whether points lose contrast to the surroundings with the angle to their normal."""
    if inspected.obs.ambient is None:
        return Evidence(
            None, "without the temperature of the surroundings nobody knows what is seen in place of emission"
        )
    found = gained(inspected, "directional_emissivity", "the angle to the normal changes values by")
    power = selected_kind(inspected, "directional_emissivity")
    if power is None:
        return found
    fit, model = inspected.joint
    falloff = round(falloff_of(fit, power, *fit.before_path(model, "directional_emissivity")), 3)
    return replace(found, settings={"falloff": max(falloff, 0.02), "power": power})


def passing(fit: Fit, power: int, excess: Tensor, basis: Tensor, weights: Tensor) -> Tensor:
    """Share of the excess over the surroundings that is emitted towards the camera [P, F]."""
    return 1.0 - falloff_of(fit, power, excess, basis, weights) * slant(fit.data, power)


def falloff_of(fit: Fit, power: int, excess: Tensor, basis: Tensor, weights: Tensor) -> float:
    """The share in [0, LARGEST] that is lost along a surface: the one that explains best, beside the points' own basis, an
    excess over the surroundings.

    Args:
        fit: of the tracks, with normals.
        power: of 1 - cos θ.
        excess, weights: [P, F] as ``Fit.before_path`` gives them.
        basis: [P, F, k].
    """
    lost, falloff = slant(fit.data, power), 0.0
    for _ in range(STEPS):
        share = 1.0 - falloff * lost
        shown = share[..., None] * basis
        own = own_part(shown, excess, weights)
        columns = Columns.dense(torch.stack([excess - own, -lost * own / share], 2))
        products = fit.gram(shown, columns, weights)
        step = float(products[0, 1] / products[1, 1]) if products[1, 1] > 0 else 0.0
        before, falloff = falloff, min(max(falloff + step, 0.0), LARGEST)
        if abs(falloff - before) < CLOSE:
            break
    return falloff


def on_surfaces(fit: Fit, more: Model, less: Model) -> bool:
    """Whether a falloff explains, at the usual of the points that it changes most, a good part of what harmonics of its own do.

    Blur takes contrast of slanted points, as a falloff would; but also from afar and beside edges, which a falloff leaves.
    """
    excess, basis, weights = fit.before_path(more, "directional_emissivity")
    taken = slant(fit.data, more.kind("directional_emissivity")) * own_part(basis, excess, weights)
    taken = (weights * (taken - own_part(basis, taken, weights)) ** 2).sum(1) / (weights > 0).sum(1).clamp_min(1)
    own = less.plus("view_dependence")
    explained, possible = (fit.variances(less) - fit.variances(one) for one in (more, own))
    used = (weights > 0).any(1)
    asked = used & (taken >= taken[used].quantile(1.0 - CHANGED)) & (possible > 0)
    return bool(asked.any()) and float((explained / possible)[asked].median()) > SHOWN


def slant(data: Data, power: int) -> Tensor:
    """(1 - cos θ) to a power, θ being the angle between line of sight and normal, [P, F]."""
    facing = (data.tracks.directions * data.normals[:, None]).sum(2).abs().clamp(max=1.0)
    return math.prod([1.0 - facing] * power)


def kinds(fit: Fit) -> Sequence[object]:
    data = fit.data
    return POWERS if data.moves and data.normals is not None and data.ambient is not None else ()


EFFECT = Effect(
    name="directional_emissivity",
    stage="emission",
    place=0,
    summary="surfaces emit less towards their sides",
    source="emissivity of dielectrics, Schlick (1994); Kirchhoff's law",
    null="a point looks the same from above and from the side",
    # Up to 43 without it: blur and uneven pixels look a little like it, and gain too little where left out, or beside harmonics.
    # From 1075 with it.
    threshold=SHARED_HURDLE,
    adds="one number for all surfaces, a normal and a tilt for each Gaussian",
    evidence=evidence,
    part=Part("path", "directional_emissivity"),
    term=Path(
        passing=passing,
        kinds=kinds,
        numbers=lambda data, kind: 1,
        unseen=lambda data: "the points show no surface",
        told_by=((on_surfaces, MORE),),
        smallest=0.1,
    ),
)
