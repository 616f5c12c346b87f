"""Heat that flows between neighbouring parts of a surface."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.effects import heat_source
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.least_squares import own_part
from heatsplat.effects.joint.model import Model
from heatsplat.effects.weathered import CHANCE, MIN_DB, NO_BALANCE
from heatsplat.physics.common_course import least_squares, response

NEIGHBOURS = 6
MIN_POINTS, MIN_STRONG = 40, 25  # points, and those that differ clearly from their neighbours
STRONG = 5.0  # times the noise by which these do
# How much faster than levels contrasts must fade: bodies of one level but two rates look a little like it.
FASTER = 1.35
UNSURE = (0.5, 2.0)  # statistics between which sheets of two rates and weak flows are alike
# The statistic by distances of levels from one another, which need no temperature at which surfaces settle: -1.1 to 0.6 on 11 of
# 12 random scenes (tiny) without a flow, and 0.8 to 18 on 20 of 24 with one, which fades these distances as well.
APART = 0.7
# Rates per span, between which contrasts and levels may answer a source, a factor of 1.1 apart.
ANSWERS = torch.logspace(-1, 2, 73, dtype=torch.float64)
STEADY = 1e-3  # ridge of the numbers with which points answer: noise in few frames passes for fast answers
LEFT = 0.02  # levels that fade to less than this share are gone in the noise


def evidence(inspected: Inspection) -> Evidence:
    """Whether contrasts between neighbours fade faster than the levels that they share.

    Where every point relaxes by itself, an excess and a difference of two excesses fade alike. So they do where a camera's gain
    drifts, which may pass for relaxation of all points, but not for a flow: that has courses of its own. Where a source drives
    the points they do not fade, but contrasts answer it as fast as levels do. Of what levels fade, the temperature of the
    surroundings, may be wrong; so what they differ by from one another has to agree.
    """
    obs = inspected.obs
    if inspected.joint is None or obs.times_s is None:
        return Evidence(None, obs.why or "no point can be followed over time")
    fit, model = inspected.joint
    if fit.data.drivers is not None:
        return _in_weather(inspected)
    if "relaxation" not in model.names or "harmonic_source" in model.names:
        if "harmonic_source" in model.names:
            return _driven(inspected)
        doubt = inspected.certainty.doubts.get("relaxation") or inspected.certainty.few("relaxation")
        if doubt and "relaxation" not in model.names and inspected.certainty.changes:
            return Evidence(None, f"cannot be told, as whether anything changes over time: {doubt}", told=False)
        return Evidence(0.0, "nothing changes over time, so that no flow between neighbours shows")
    early, late, used = early_and_late(fit, model)
    points = obs.tracks.points[used]
    if len(points) < MIN_POINTS:
        why = f"cannot be told: {len(points)} points are too few to have neighbours, {MIN_POINTS} are needed"
        return Evidence(None, why, told=False)
    near = _neighbours(points)
    first, last = early[used], late[used]
    before, after = first[near].mean(1), last[near].mean(1)
    apart = _kept_apart(before, after)
    kept = apart if "frame_offset" in model.names else _kept(before, after, obs.ambient)
    contrast, remains = first - before, last - after
    strong = contrast.abs() > STRONG * obs.noise
    if int(strong.sum()) < MIN_STRONG or kept < LEFT:
        why = "neighbours are too much alike, or all is cold in the end; a shorter record of finer patterns would tell"
        return Evidence(None, f"cannot be told: {why}", told=False)
    still = (remains[strong] / contrast[strong]).median().clamp_min(LEFT)
    statistic, by_distance = (_faster(still, share) for share in (kept, apart))
    found = (
        f"contrasts between neighbours fade to {float(still):.2f} while levels fade to {float(kept):.2f} of "
        f"{_of_what(inspected, model)}"
    )
    if UNSURE[0] < statistic < UNSURE[1]:
        return Evidence(statistic, f"{found}: cannot be told, bodies of two rates would do that as well", told=False)
    if (statistic > UNSURE[1]) != (by_distance > APART) and "frame_offset" not in model.names:
        but = f"but to {float(apart):.2f} of what they differ from one another by"
        why = "surfaces may settle at another temperature than the surroundings'; a right ambient_c would tell"
        return Evidence(statistic, f"{found}, {but}: cannot be told, {why}", told=False)
    return Evidence(statistic, found)


def _faster(still: Tensor, kept: Tensor) -> float:
    """By how much faster contrasts fade, to a share ``still``, than levels, to a share ``kept``: 1 at FASTER times their rate."""
    rate = float(still.log() / kept.clamp(LEFT, 0.999).log())
    return (rate - 1.0) / (FASTER - 1.0)


def _of_what(inspected: Inspection, model: Model) -> str:
    """What levels fade in, in words: where surfaces settle at another temperature than the surroundings are said to have, levels
    seem to fade less than contrasts."""
    if "frame_offset" in model.names:
        return "what they differ by"
    ambient_c = inspected.scene.ambient_c
    if inspected.obs.ambient is None:
        return "what they differ from the coldest of them by, or the warmest, as nobody knows the surroundings"
    return f"what they differ from the surroundings by ({ambient_c:g} °C)"


def _driven(inspected: Inspection) -> Evidence:
    """Whether contrasts between neighbours answer a source as fast as the levels that they share.

    A flow adds to the rate at which they do. Bodies of two rates would as well, so that it is never found beside a source.
    """
    hidden = Evidence(None, "cannot be told: a source hides how contrasts fade", told=False)
    source = inspected.heat_source
    seen = None if source is None or not source.common else heat_source.answering(inspected)
    if seen is None:
        return hidden
    values, weights, points = seen
    if len(points) < MIN_POINTS:
        return hidden
    spans = heat_source.spans(inspected)
    basis = torch.cat(response(source.course, spans, heat_source.RATES_OF_POINTS), 1)
    clean = least_squares(values, weights, basis, STEADY)[0] @ basis.T
    levels = clean[_neighbours(points)].mean(1)
    contrasts = clean - levels
    strong = contrasts.std(1) > STRONG * inspected.obs.noise
    if int(strong.sum()) < MIN_STRONG:
        return hidden
    slow, fast = (_rate(source.course, spans, one[strong]) for one in (levels, contrasts))
    statistic = (fast / slow - 1.0) / (FASTER - 1.0)
    found = f"contrasts between neighbours answer the source at {fast / slow:.2f} times the rate of the levels that they share"
    if statistic > UNSURE[0]:
        return Evidence(None, f"{found}: cannot be told, bodies of two rates would do that as well", told=False)
    return Evidence(max(statistic, 0.0), found)


def _rate(course: Tensor, spans: Tensor, values: Tensor) -> float:
    """The rate per span at which values [P, F] answer a course of power [K] (``physics.common_course``); each counts alike."""
    decays, driven = response(course, spans, ANSWERS)
    values, ones = values / values.norm(dim=1, keepdim=True), torch.ones_like(values)
    explained = [
        least_squares(values, ones, torch.stack([decays[:, rate], driven[:, rate]], 1))[1].sum()
        for rate in range(len(ANSWERS))
    ]
    return float(ANSWERS[torch.stack(explained).argmax()])


def _neighbours(points: Tensor) -> Tensor:
    """Which points [P, NEIGHBOURS] are nearest to points [P, 3]."""
    return torch.cdist(points, points).topk(NEIGHBOURS + 1, largest=False).indices[:, 1:]


def _in_weather(inspected: Inspection) -> Evidence:
    """Whether points lean to their neighbours. Levels follow the weather, so that nobody knows how fast they would fade by
    themselves; what is common to neighbours may be what a balance misses of both."""
    gain = None if inspected.weathered is None else inspected.weathered.flow
    if gain is None:
        return Evidence(None, inspected.obs.why or NO_BALANCE, told=False)
    found = f"a share of what points lack to their neighbours gains {gain.db:.2f} dB where left out"
    if gain.sigmas < CHANCE or gain.db < MIN_DB:
        return Evidence(0.0, found)
    return Evidence(None, f"{found}: cannot be told, a balance may err alike for neighbours", told=False)


def early_and_late(fit: Fit, model: Model) -> tuple[Tensor, Tensor, Tensor]:
    """What the points' own parts say of the first and the last fifth of the record [P] each, and which points [P]
    were seen in both."""
    values, basis = fit.own(model)
    own = own_part(basis, values - sum(fit.contributions(model).values()), fit.weights)
    own = own + (fit.data.ambient if model.kind("attenuation") else 0.0)
    first, last = fit.data.passed <= 0.2, fit.data.passed >= 0.8
    used = fit.weights > 0
    both = used[:, first].any(1) & used[:, last].any(1)
    return own[:, first].mean(1), own[:, last].mean(1), both


def _kept(before: Tensor, after: Tensor, ambient: float | None) -> Tensor:
    """The share of their excess over the surroundings that levels keep."""
    if ambient is None:
        warms = bool((after - before).median() > 0)
        ambient = float(torch.maximum(before, after).max() if warms else torch.minimum(before, after).min())
    excess = before - ambient
    clear = excess.abs() >= excess.abs().median().clamp_min(1e-9)
    return ((after - ambient)[clear] / excess[clear]).median() if clear.any() else torch.zeros(())


def _kept_apart(before: Tensor, after: Tensor) -> Tensor:
    """The share of their distance from one another that levels keep.

    A drift of the sensor and a cooling of all points are told apart up to an offset that all share; distances lack it.
    """
    far, rest = before - before.median(), after - after.median()
    clear = far.abs() >= far.abs().median().clamp_min(1e-9)
    return (rest[clear] / far[clear]).median() if clear.any() else torch.zeros(())


EFFECT = Effect(
    name="conduction",
    stage="state",
    place=6,
    summary="heat conduction between neighbouring parts of a surface",
    source="Fourier's law on the graph of nearest Gaussians",
    needs=frozenset({"time"}),
    null="contrasts between neighbours fade as fast as temperatures do",
    # Contrasts fade FASTER; up to 0.2 without it, from 2.9 with it.
    threshold=1.0,
    adds="a diffusivity and a linear solve over neighbours",
    evidence=evidence,
    part=Part("around_state", "conducting"),
    stands_on="relaxation",
)
