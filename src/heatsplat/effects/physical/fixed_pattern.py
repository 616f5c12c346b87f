"""Uneven gain and offset of the pixels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.heat_source import KNOWN, NAME, PATTERNS
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.certainty import Certainty
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.evidence import beside, judged
from heatsplat.effects.joint.image_grid import STILL, grid_columns
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.selection import worthwhile
from heatsplat.effects.joint.terms import OWN_HURDLE, Shared, centred, where_moving
from heatsplat.effects.physical import relaxation, vignetting

NODES, NODES_FEW = 7, 5  # along the sides of the grids on which a pattern is looked for
MANY = 10_000  # observations from which the finer grid pays
SURE = 8.0  # gain above which it is no error of what else is fitted
FIFTH_DB = 1.0  # nor is a fifth of all that the others leave
WELL_SEEN = 2.5  # observations of a point for each of its own numbers before a driven scene is taken for granted


def evidence(inspected: Inspection) -> Evidence:
    """Whether places in the image have an offset or gain of their own. Where the image fades towards its corners, the radial
    part is left to vignetting."""
    if inspected.joint is None:
        return Evidence(None, inspected.obs.why)
    certainty = inspected.for_patterns
    fit = certainty.fit
    if not fit.data.moves:
        return Evidence(None, STILL)
    none = certainty.beside_weather(certainty.model.minus(PATTERNS))
    share, gain = vignetting.falloff(fit, none)
    fades = share < vignetting.MIN_FALLOFF
    fades = fades and (gain > vignetting.EFFECT.threshold or vignetting.makes_do_alone(certainty, none))
    less = none.plus("vignetting") if fades else none
    more = less.plus("fixed_pattern")
    found = "places in the image differ" + (" beside the falloff" if fades else "") + " by"
    if worthwhile(fit, more, less, "fixed_pattern") and fit.gain(more, less) > 1.0:
        evidence = judged(certainty, "fixed_pattern", found, more, less)
        # Without it nothing is lost either where the courses of a driven scene take it, which are any.
        courses = less.kind(NAME) not in (None, KNOWN)
        lost = evidence.statistic > 0 or courses
        if evidence.told and lost and evidence.statistic < SURE and not _much(certainty, more, less):
            return replace(evidence, told=False, reason=f"{evidence.reason}: cannot be told, more frames would tell")
        return evidence
    return Evidence(0.0, f"{found} {beside(fit.effect_size(more, less))}")


def _much(certainty: Certainty, more: Model, less: Model) -> bool:
    """Whether a pattern gains a fifth of all that the others leave; also if those of them are left out that may not be there.

    What changes over time or from image to image stays: it may be something else, but something changes the images.
    """
    fit = certainty.fit
    if fit.data.rough:
        return False
    terms = {name: fit.data.effects[name].term for name in less.names & certainty.doubts.keys()}
    doubted = [name for name, term in terms.items() if not (term.in_time or term.single_images)]
    return all(certainty.compared(more.minus(rest), less.minus(rest)).db > FIFTH_DB for rest in ((), doubted))


def nodes(data: Data) -> int:
    """Along the sides of the grid."""
    return NODES if data.tracks.weights.sum() > MANY else NODES_FEW


def columns(data: Data, image: Tensor, known: Mapping[str, Tensor]) -> Columns:
    """Offsets and gains on a grid over the image."""
    return grid_columns(data.tracks, image, nodes(data))


def starts(data: Data) -> Sequence[Model]:
    """A driven scene before an uneven camera."""
    well_seen = data.usual_length >= WELL_SEEN * (2 + relaxation.count(data))
    driven = data.moves and "harmonic_source" in data.rich.names and well_seen
    return (data.rich.minus({"frame_offset", "agc"}).plus("fixed_pattern"),) if driven else ()


EFFECT = Effect(
    name="fixed_pattern",
    stage="sensor",
    place=3,
    summary="uneven gain and offset of the pixels",
    source="SupIR-GS, Eq. 6",
    null="residuals average to zero at every image position",
    # All points share it, but how courses of points err looks like a pattern on heated scenes: it has gained 1.7 there.
    # Up to 1.2 without it, from 6.0 with it.
    threshold=OWN_HURDLE,
    adds="two coarse grids over the image",
    evidence=evidence,
    part=Part("camera", "calibration", off={"gain_max": 0.0, "bias_max": 0.0}),
    term=Shared(
        columns=columns,
        order=1,
        settled=lambda numbers: torch.cat([centred(half) for half in numbers.chunk(2)]),
        kinds=where_moving,
        numbers=lambda data, kind: 2 * nodes(data) ** 2 - 2,
        starts=starts,
        sensor_first=True,
        # Where neighbours exchange heat, what the courses of points miss looks like a pattern of 0.004 of the changes; true ones
        # have 0.017 and more.
        beside_changes=0.008,
    ),
)
