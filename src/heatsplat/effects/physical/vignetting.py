"""Falloff of the lens towards the corners."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.heat_source import PATTERNS
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.certainty import Certainty
from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.evidence import beside
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.image_grid import STILL, grid_columns
from heatsplat.effects.joint.least_squares import scaled
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.selection import worthwhile
from heatsplat.effects.joint.terms import SHARED_HURDLE, Shared, where_moving

MIN_FALLOFF = -0.04  # in the corners; blur at the border of an image passes for half of that
WILD = 0.1  # share that errors of a weather's record make, as those that no lens adds
FINE_NODES = 9  # where the pattern is a random field, which more nodes than it needs do no harm
UNSURE = (0.5, 3.0)  # gains between which random patterns have their own falloffs, and true ones may stay
STRENGTHS = 12  # iterations for the strength of that field


def evidence(inspected: Inspection) -> Evidence:
    """Whether the image fades towards its corners."""
    if inspected.joint is None:
        return Evidence(None, inspected.obs.why)
    certainty = inspected.for_patterns
    fit = certainty.fit
    if not fit.data.moves:
        return Evidence(None, STILL)
    none = certainty.beside_weather(certainty.model.minus(PATTERNS))
    radial = none.plus("vignetting")
    share, gain = falloff(fit, none)
    size = fit.effect_size(radial, none)
    why = (
        f"distance from the middle of the image changes values by {beside(size)} ({100 * share:+.0f} % in the corners)"
    )
    if fit.data.rough and _heat_may_be_it(fit, radial, none, share, gain):
        why = f"{why}: cannot be told, heat may pass for it or hide it; more frames would tell"
        return Evidence(gain, why, told=False)
    if share >= MIN_FALLOFF:
        return Evidence(0.0, f"{why}, which is no falloff")
    alone = makes_do_alone(certainty, none)
    gain = max(gain, fit.gain(radial, none)) if alone else gain
    if not worthwhile(fit, radial, none, "vignetting"):
        return Evidence(0.0, why)
    worth = certainty.worth("vignetting", radial, none)
    doubt = worth.doubt or certainty.doubts.get("vignetting", "")
    if UNSURE[0] < gain < UNSURE[1] and not alone:
        doubt = "a pattern of the camera may have as much of a falloff; more frames would tell"
    told = gain <= UNSURE[0] or not doubt
    return Evidence(gain, why if told else f"{why}: cannot be told, {doubt}", told=told, gain_db=worth.held_out.db)


def _heat_may_be_it(fit: Fit, radial: Model, none: Model, share: float, gain: float) -> bool:
    """Whether what a weather record misses of heat passes for a falloff of that ``share`` and ``gain``, or hides one.

    It does where the falloff is unlikely large, and where something goes with the distance from the middle that is no clear one.
    """
    wild = share > WILD or share < -WILD and gain < UNSURE[0]
    fades = share < MIN_FALLOFF and gain > UNSURE[0] and worthwhile(fit, radial, none, "vignetting")
    return wild or not fades and fit.effect_size(radial, none) >= EFFECT.term.smallest


def makes_do_alone(certainty: Certainty, none: Model) -> bool:
    """Whether a falloff foresees what was left out better than any pattern of the camera does.

    Args:
        none: the model without falloff and pattern.
    """
    radial, pattern = none.plus("vignetting"), none.plus("fixed_pattern")
    chosen = "vignetting" in certainty.model.names and "fixed_pattern" not in certainty.model.names
    return chosen and certainty.compared(radial, pattern).db > 0


def columns(data: Data, image: Tensor, known: Mapping[str, Tensor]) -> Columns:
    """A gain that goes with the second and the fourth power of the distance from the middle of the image."""
    r2 = data.tracks.radii
    return Columns.dense(torch.stack([r2, r2**2], 2) * image[..., None])


def falloff(fit: Fit, none: Model) -> tuple[float, float]:
    """By what share the image is brighter in its corners than in its middle (negative where it fades), and what such
    a falloff gains when the rest of the pattern is a random field as strong as it turns out to be.

    A random field has a radial part, too; a falloff is there when that part stands out of what its other parts lead
    one to expect. The strength of the field is found by expectation and maximisation, and the falloff has to earn its
    two numbers against the field's nodes, of which each is about one observation of it.

    Args:
        fit: joint fit.
        none: its model without falloff and pattern.
    """
    image, shared = fit.image(none), fit.shared_columns(none)
    values, basis = fit.own(none)
    radial, field = columns(fit.data, image, fit.known), grid_columns(fit.data.tracks, image, FINE_NODES)
    products = fit.gram(basis, Columns.joined([Columns.dense(values[..., None]), field, radial, *shared.values()]))
    inner, right, scale = scaled(products)
    inner = inner + 1e-8 * torch.eye(len(inner), dtype=inner.dtype)
    n, half = field.count, field.count // 2
    loose = torch.zeros(len(inner), dtype=inner.dtype)  # inverse variances of the field's nodes in scaled units
    loose[:n] = 1e-2 / scale[:n] ** 2
    for _ in range(STRENGTHS):
        inverse = torch.linalg.inv(inner + loose.diag())
        found = ((inverse @ right) ** 2 + inverse.diagonal()) * scale**2
        for part in (slice(0, half), slice(half, n)):
            loose[part] = 1.0 / (found[part].mean().clamp_min(1e-12) * scale[part] ** -2)
    inverse = torch.linalg.inv(inner + loose.diag())
    two = slice(n, n + radial.count)
    numbers = (inverse @ right)[two]
    stands_out = float(numbers @ torch.linalg.solve(inverse[two, two], numbers))
    return float((numbers * scale[two]).sum()), stands_out / (radial.count * math.log(n))


EFFECT = Effect(
    name="vignetting",
    stage="sensor",
    place=4,
    summary="falloff of the lens towards the corners",
    source="SupIR-GS, Eq. 4",
    null="residuals do not depend on the distance from the image centre",
    # Up to 0.3 without it, from 0.4 with it: beside a heat source it is missed.
    threshold=SHARED_HURDLE,
    adds="two numbers",
    evidence=evidence,
    part=Part("camera", "calibration", off={"vignetting_max": 0.0}),
    term=Shared(
        columns=columns,
        order=2,
        kinds=where_moving,
        numbers=lambda data, kind: 2,
        sensor_first=True,
        # Where neighbours exchange heat, what the courses of points miss looks like a pattern of 0.004 of the changes; true ones
        # have 0.017 and more.
        beside_changes=0.008,
    ),
)
