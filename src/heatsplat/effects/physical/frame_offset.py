"""A level of the sensor that drifts from image to image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.evidence import gained, judged, outdone
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.least_squares import own_part
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.terms import SHARED_HURDLE, Shared, centred

NOT_COMMON = "what images have in common is not common to all points; more frames would tell heat from the camera"
# Share of what numbers of all points explain of one half of them that those of the other half have to explain.
IN_COMMON = 0.5


def evidence(inspected: Inspection) -> Evidence:
    """Whether each image has an offset that all its points share. Where gains change, their shift takes it."""
    sentence = "images differ from each other by an offset of"
    both = inspected.joint is not None and {"agc", "frame_offset"} <= inspected.joint[1].names
    if both and not outdone(inspected, "agc", {"frame_offset", "tone"}):
        fit, model = inspected.joint
        alone = fit.without(model, "agc")
        if inspected.certainty.idle("agc", model, alone):  # gains that are left out take no offsets
            return judged(inspected.certainty, "frame_offset", sentence, alone, fit.without(alone, "frame_offset"))
        found = "gains change from image to image, and their shift takes what offsets there are"
        doubt = inspected.certainty.doubts.get("agc")
        return Evidence(None, f"{found}, if they do: {doubt}", told=False) if doubt else Evidence(0.0, found)
    return gained(inspected, "frame_offset", sentence)


def columns(data: Data, image: Tensor, known: Mapping[str, Tensor]) -> Columns:
    """An offset for each frame."""
    return Columns.of_images(torch.ones_like(image))


def starts(data: Data) -> Sequence[Model]:
    """A still scene that cools before a still camera that drifts."""
    cools = not data.moves and "relaxation" in data.rich.names
    return (Model.of(relaxation=1, frame_offset=1),) if cools else ()


def in_common(fit: Fit, more: Model, less: Model) -> bool:
    """``common_to_all``, and more than balances of heat err together; where nothing changes there is nothing to ask."""
    return not fit.may_change(less) or common_to_all(fit, more, less) and not as_balances_err(fit, more, less)


def as_balances_err(fit: Fit, more: Model, less: Model) -> bool:
    """Whether what single images have in common, beside what balances of heat of their points may make of it, is no more than
    these err together."""
    if fit.data.balances is None:
        return False
    shared = fit.contributions(more)
    single = [name for name in shared.keys() - less.names if fit.data.effects[name].term.single_images]
    added, basis, used = sum(shared[name] for name in single), fit.own_basis(more), (fit.weights > 0).double()
    free = used.sum(1) - basis.shape[2]
    beyond = ((added - own_part(basis, added, used)) ** 2 * used).sum(1) / free.clamp_min(1.0)
    return bool((free > 0).any()) and float(beyond[free > 0].median().sqrt()) < fit.data.balances_err


def common_to_all(fit: Fit, more: Model, less: Model) -> bool:
    """Whether what the points that change most say of every image holds for those that change least, and conversely.

    A sensor changes all points alike; a lamp does not. Each half has to explain the other about as well as both together do:
    whatever else is left, such as what misplaced cameras make of edges, counts for neither. Effects that are not of single
    images keep what all points say of them.
    """
    weights, values = fit.weights, fit.data.tracks.values
    used = weights > 0
    mean = (values * used).sum(1) / used.sum(1).clamp_min(1)
    change = (((values - mean[:, None]) ** 2 * used).sum(1) / used.sum(1).clamp_min(1)).sqrt()
    loud = change > change[used.any(1)].median()
    shared = fit.terms(more, Shared)
    held = [name for name, one in shared.items() if not one.term.single_images]
    added = fit.contributions(more)
    tracks = replace(fit.data.tracks, values=values - sum(added[name] for name in held))
    known_to_all = {name: value for name, value in fit.known.items() if name not in held}
    rest, beside = more.minus(held), replace(fit, data=replace(fit.data, tracks=tracks), known=known_to_all)
    own, basis = beside.own(rest)

    def left(known: Tensor) -> Tensor:
        """Weighted squares [P] that the numbers of the points ``known`` [P] leave."""
        values = own - sum(beside.contributions(rest, weights * known[:, None]).values())
        return (weights * (values - own_part(basis, values, weights)) ** 2 / fit.trust[:, None]).sum(1)

    before = (weights * fit.residuals(less) ** 2 / fit.trust[:, None]).sum(1)
    together = left(torch.ones_like(loud))
    for known in (loud, ~loud):
        explained, possible = ((before - after)[~known].sum() for after in (left(known), together))
        if explained < IN_COMMON * possible or possible <= 0:
            return False
    return True


EFFECT = Effect(
    name="frame_offset",
    stage="sensor",
    place=5,
    summary="sensor offset that drifts from image to image",
    source="drift of uncooled cameras between shutters",
    null="no offset is common to all points of an image",
    # Up to 0.9 without it, from 71 with it.
    threshold=SHARED_HURDLE,
    adds="one number for each training image",
    evidence=evidence,
    part=Part("camera", "frame_offset"),
    term=Shared(
        columns=columns,
        order=4,
        settled=centred,
        kinds=lambda fit: (1,),
        numbers=lambda data, kind: data.frames - 1,
        single_images=True,
        told_by=((common_to_all, NOT_COMMON),),
        rich=lambda data: 1,
        starts=starts,
        sensor_first=True,
        beside_changes=0.03,
        rules=(in_common,),
    ),
)
