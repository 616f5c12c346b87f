"""Air that swallows heat over distance and sends its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.evidence import gained, selected_kind
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.terms import SHARED_HURDLE, Path
from heatsplat.physics.curves import smooth_values

EVEN = "even"  # a share that each image loses from near and far alike
MAX_DEPTH = 3.0  # optical depth at the typical distance
THINNEST = 0.02  # optical depth there from which training starts at the least
MOMENTS = 32  # of the course over a record, at most
BEND = 1e-4  # weight of its second differences, which decide where no image was taken


def evidence(inspected: Inspection) -> Evidence:
    """Whether points lose contrast to the surroundings with distance."""
    if inspected.obs.ambient is None:
        return Evidence(None, "without the temperature of the surroundings nobody knows what haze fades to")
    found = gained(inspected, "attenuation", "the path changes values by")
    kind = selected_kind(inspected, "attenuation")
    if kind is None:
        return found
    fit, model = inspected.joint
    per_unit, _ = extinctions(fit, kind, *fit.before_path(model, "attenuation"))
    return replace(found, settings=settings(per_unit * inspected.given.distance, inspected))


def settings(depths: Tensor, inspected: Inspection) -> dict[str, Any]:
    """What the part starts from: optical depths at the typical distance, of the scene [1] or of each image [F].

    What the joint fit knows of them to a thousandth training would have to find anew, beside surfaces that can be brighter
    through thicker air.
    """
    times_s = inspected.obs.times_s
    no_record = times_s is None or bool((times_s == times_s[0]).all())  # along which it could change
    if len(depths) == 1 or no_record:
        return {"depth": round(max(float(depths.mean()), THINNEST), 3), "moments": 0}
    first, span = inspected.given.record
    count = max(2, min(len(depths), MOMENTS))
    places = (times_s - first) / span * (count - 1)
    curve = smooth_values(places, depths, count, BEND).clamp(THINNEST, MAX_DEPTH)
    return {"depth": [round(depth, 4) for depth in curve.tolist()], "moments": count}


def passing(fit: Fit, kind: object, excess: Tensor, basis: Tensor, weights: Tensor) -> Tensor:
    """Share of the excess over the surroundings that arrives [P, F]."""
    depths, columns = extinctions(fit, kind, excess, basis, weights)
    return torch.exp(-(columns @ depths))


def extinctions(fit: Fit, kind: object, excess: Tensor, basis: Tensor, weights: Tensor) -> tuple[Tensor, Columns]:
    """Extinctions [c], and what each counts for in an observation: distances in world units, or for ``EVEN`` 1.

    The logarithm of the excess is linear in the extinction (Beer-Lambert), so it comes from one linear fit there.
    """
    tracks = fit.data.tracks
    sign = torch.sign((excess * tracks.weights).sum(1, keepdim=True))
    clear = (excess.abs() > 8.0 * fit.errors) & (excess * sign > 0)
    logs = torch.where(clear, excess.abs(), torch.ones_like(excess)).log()
    typical = float((tracks.distances * tracks.weights).sum() / tracks.weights.sum())
    counted = torch.ones_like(excess) if kind == EVEN else tracks.distances / typical
    columns = Columns.of_images(counted) if kind in ("varying", EVEN) else Columns.dense(counted[..., None])
    products = fit.gram(basis, Columns.joined([Columns.dense(logs[..., None]), columns]), weights * excess**2 * clear)
    ridge = 1e-8 * products.diagonal()[1:].mean().clamp_min(1e-300) * torch.eye(columns.count, dtype=products.dtype)
    depths = -torch.linalg.solve(products[1:, 1:] + ridge, products[1:, 0])
    if kind == EVEN:
        depths = depths - depths.min()  # what all images lose, points lack themselves
    unit = 1.0 if kind == EVEN else typical
    return depths.clamp(0.0, MAX_DEPTH) / unit, columns * unit  # air only takes away


def numbers(data: Data, kind: object) -> int:
    return 1 if kind == "constant" else data.frames


def with_distance(fit: Fit, more: Model, less: Model) -> bool:
    """Whether a share that goes with distance explains more than one that each image loses from near and far alike, as where a
    lamp heats all."""
    return fit.quality(more).bic < fit.quality(more.plus("attenuation", EVEN)).bic


def kinds(fit: Fit) -> Sequence[object]:
    """One extinction, or one that varies over time."""
    return ("constant", "varying") if fit.data.ambient is not None and fit.data.moves else ()


EFFECT = Effect(
    name="attenuation",
    stage="path",
    place=0,
    summary="air that absorbs radiation over distance and emits its own",
    source="TI-3DGS, Eq. 8; Beer and Lambert",
    null="a point looks the same from near and far",
    # Up to 0.9 without it; from 30 with it, and 0 once, where haze passes for heat.
    threshold=SHARED_HURDLE,
    adds="one extinction coefficient, or its course over time",
    evidence=evidence,
    part=Part("path", "attenuation"),
    term=Path(
        passing=passing,
        kinds=kinds,
        numbers=numbers,
        rivals=(("relaxation", "harmonic_source"),),
        told_by=(
            (with_distance, "near and far points lose alike, as where a lamp heats all; other distances would tell"),
        ),
        smallest=0.2,  # misplaced points go with distance a little
    ),
)
