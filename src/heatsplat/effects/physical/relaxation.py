"""Every surface tends to the temperature of its surroundings."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.courses import DECAYS, DECAYS_FEW, LONG
from heatsplat.effects.joint.data import MIN_FREE, Data
from heatsplat.effects.joint.evidence import gained
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.held_out import HeldOut
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.terms import OWN_HURDLE, Own, well_seen
from heatsplat.effects.weathered import MIN_DB, SIGMAS, weighed

BESIDE_DRIFT = 0.25  # share of a common offset that other changes must exceed before a still camera


def evidence(inspected: Inspection) -> Evidence:
    """Whether points tend to another temperature as time goes by; what follows sun, sky or wind does."""
    weathered, joint = inspected.weathered, inspected.joint
    if joint is not None and joint[0].data.balances is not None:
        return weighed(weathered.follows, _over_levels(weathered.follows))
    found = gained(inspected, "relaxation", "points change over time by")
    on = found.told and found.statistic is not None and found.statistic > EFFECT.threshold
    if not on and weathered is not None and weathered.follows.exceeds(MIN_DB, SIGMAS):
        gain = weathered.follows
        return Evidence(gain.sigmas, _over_levels(gain), gain_db=gain.db)
    return found


def _over_levels(gain: HeldOut) -> str:
    return f"balances of heat gain {gain.db:.2f} dB over levels where left out, {gain.sigmas:.1f} standard errors"


def rates(data: Data) -> tuple[float, ...]:
    """Of the decays that the record can tell apart, times its length."""
    return DECAYS if data.usual_length >= LONG else DECAYS_FEW


def count(data: Data) -> int:
    """How many numbers of its own a point has for its course over time."""
    return len(rates(data)) if data.drivers is None else data.drivers.shape[1]


def decays(fit: Fit, kind: object) -> Tensor:
    """Courses over time [F, k] of which each point has a mixture; with a weather record, what surfaces make of that."""
    data = fit.data
    if data.drivers is not None:
        return data.drivers
    return torch.exp(-data.passed[:, None] * torch.tensor(rates(data), dtype=torch.float64))


def kinds(fit: Fit) -> Sequence[object]:
    data = fit.data
    return (1,) if data.span_s > 0 and data.usual_length >= MIN_FREE + 1 + count(data) else ()


def rich(data: Data) -> object | None:
    return 1 if data.span_s > 0 and data.usual_length >= 2 * (1 + len(rates(data))) else None


def unseen(data: Data) -> str:
    return "all frames show one moment" if data.span_s <= 0 else "points are seen in too few frames"


def beyond_drift(fit: Fit, more: Model, less: Model) -> bool:
    """Whether a still camera sees more than its own drift. Surfaces do not all change alike; a drift is one offset of
    the whole image, and leaves a pattern of its own that is small beside it."""
    if fit.data.moves:
        return True
    drift = Model.of(frame_offset=1)
    return fit.effect_size(more.plus("frame_offset"), drift) > BESIDE_DRIFT * fit.effect_size(drift, Model())


EFFECT = Effect(
    name="relaxation",
    stage="state",
    place=0,
    summary="surfaces relax to the temperature of their surroundings",
    source="ETGS, Eq. 3",
    needs=frozenset({"time"}),
    null="every point keeps its temperature over the record",
    # Up to 0.2 without it, and 3.2 once, in haze; from 3.3 with it.
    threshold=OWN_HURDLE,
    adds="a level and a rate for each Gaussian, an exponential at each time",
    evidence=evidence,
    part=Part("state", "newton_harmonic"),
    term=Own(
        basis=decays,
        in_time=True,
        kinds=kinds,
        rich=rich,
        unseen=unseen,
        frames=lambda data: well_seen(1 + count(data)) if data.span_s > 0 else 0,
        rules=(beyond_drift,),
    ),
)
