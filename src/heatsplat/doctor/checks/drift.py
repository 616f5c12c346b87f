"""A level that drifts from frame to frame, and shutters that set it back."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.doctor.base import MIN_FRAMES, MIN_POINTS, Check, Finding, Material, some
from heatsplat.doctor.courses import beside_courses
from heatsplat.physics.noise import robust_spread

LEAST, LEAST_BESIDE = 3.0, 2.0  # times the noise of a pixel: of levels as they are, and beside each point's own course
# Share of what points differ by between frames that is left without the levels: 0.17 to 0.31 where a sensor drifts (m3t_heath:
# 0.31), 0.59 and more where surfaces mirror, which half of the points show; beside their courses 0.19 to 0.52, and 0.65.
LEFT = 0.55
# Two halves of the points tell of the same level if a sensor drifts: correlation, and range of the ratio of their sizes, of
# what leaps from frame to frame and of what wanders slowly. Where a scene warms, cools or hazes the ratio is 1.66 and more,
# and where it is not, the correlation 0.3; where a sensor drifts 1.27 and less, and 0.66 (m3t_heath: 0.95 and 1.16).
LEAPS, WANDERS = (0.55, 0.75, 1.4), (0.98, 0.9, 1.1)
# Beside each point's own course: a drifting sensor before a scene that cools has 0.98 and 1.07; a lamp, haze and weather 1.4
# and more, and a scene that only cools leaves no level above the noise.
BESIDE = (0.9, 0.8, 1.25)
JUMP = 3.0  # times the usual step between frames


def find(material: Material) -> list[Finding]:
    followed = material.followed
    if followed is None or len(followed[0]) < MIN_POINTS or len(material.images) < MIN_FRAMES:
        return []
    looks = [(*beside_courses(*followed, material), _leap_beside)]
    if material.answers is None:  # under one weather surfaces rise and fall in common
        looks.append((*followed, _in_common))
    for values, weights, drifts in looks:
        if (weights > 0).any(1).sum() < 2:  # no halves
            continue
        levels = frame_levels(values, weights)
        before, after = _spread(values, weights, torch.zeros_like(levels)), _spread(values, weights, levels)
        if after < LEFT * before and drifts(material, values, weights, levels):
            return [_finding(material, levels, before, after)]
    return []


def _finding(material: Material, levels: Tensor, before: float, after: float) -> Finding:
    shutters = [material.name(f) for f in _shutters(levels)]
    resets = f", and is set back at {some(shutters)} (shutter)" if shutters else ""
    return Finding(
        "drift",
        min(1.0, before / material.contrast),
        f"The level of all points wanders between frames by {material.size(float(levels.max() - levels.min()))}{resets}: "
        f"one point differs between frames by {material.size(before)}, by {material.size(after)} without it.",
        "method=auto simulates it (frame_offset); other methods take sensor=frame_offset.",
        tuple(shutters),
    )


def frame_levels(values: Tensor, weights: Tensor) -> Tensor:
    """Level [F] of each frame above the others, with median 0, from values [P, F] of points: alternating medians."""
    known = torch.where(weights > 0, values, torch.nan)
    levels = values.new_zeros(values.shape[1])
    for _ in range(10):
        points = (known - levels).nanmedian(dim=1, keepdim=True).values
        levels = (known - points).nanmedian(dim=0).values.nan_to_num()
        levels = levels - levels.median()
    return levels


def _leap_beside(material: Material, values: Tensor, weights: Tensor, levels: Tensor) -> bool:
    """Whether all halves of the points leap alike beside their own courses."""
    return float(_leaps(levels).std()) > LEAST_BESIDE * material.noise and all(
        _same(_leaps(one), _leaps(other), *BESIDE) for one, other in _halves(material.followed[0], values, weights)
    )


def _in_common(material: Material, values: Tensor, weights: Tensor, levels: Tensor) -> bool:
    """Whether points that change most and points that change least, warm ones and cold ones tell of the same levels."""
    if float(levels.std()) < LEAST * material.noise:
        return False
    halves = _halves(material.followed[0], values, weights)
    # Frames at uneven times leap along a smooth course, too.
    rough = float(_leaps(levels).std()) > LEAST * material.noise and _rough(material, levels) > LEAST * material.noise
    return (rough and all(_same(_leaps(one), _leaps(other), *LEAPS) for one, other in halves)) or all(
        _same(one, other, *WANDERS) for one, other in halves
    )


def _rough(material: Material, levels: Tensor) -> float:
    """Standard deviation of what levels have beside a smooth course over time."""
    return float(beside_courses(levels[None], torch.ones_like(levels)[None], material)[0].std())


def _halves(shown: Tensor, values: Tensor, weights: Tensor) -> list[list[Tensor]]:
    """Levels [F] by the points that change more and less than others in what they show, and by warm ones and cold ones."""
    used = weights > 0
    some, count = used.any(1), used.sum(1).clamp_min(1)
    mean = (shown * used).sum(1) / count
    change = (((shown - mean[:, None]) * used).square().sum(1) / count).sqrt()
    seen, halves = some.nonzero()[:, 0], []
    for order in (change, mean):
        ranked = seen[order[seen].argsort(stable=True)]  # points that change alike are in either half
        middle = (len(ranked) + 1) // 2
        halves.append([frame_levels(values[keep], weights[keep]) for keep in (ranked[middle:], ranked[:middle])])
    return halves


def _leaps(levels: Tensor) -> Tensor:
    """What a level has beyond the middle of its neighbours."""
    return levels[1:-1] - 0.5 * (levels[2:] + levels[:-2])


def _same(one: Tensor, other: Tensor, correlated: float, low: float, high: float) -> bool:
    one, other = one - one.mean(), other - other.mean()
    sizes = float(one.norm()), float(other.norm())
    if min(sizes) == 0:
        return False
    return float(one @ other) / (sizes[0] * sizes[1]) > correlated and low < sizes[0] / sizes[1] < high


def _spread(values: Tensor, weights: Tensor, levels: Tensor) -> float:
    """How much a point differs from itself in other frames: standard deviation, from the median of all."""
    left = torch.where(weights > 0, values - levels, torch.nan)
    left = left - left.nanmedian(dim=1, keepdim=True).values
    return robust_spread(left)


def _shutters(levels: Tensor) -> list[int]:
    """Frames at which the level falls or leaps by far more than from frame to frame."""
    steps = levels.diff()
    usual = float(steps.abs().median())
    return [f + 1 for f in range(len(steps)) if float(steps[f].abs()) > JUMP * max(usual, 1e-9)]


CHECK = Check("drift", "whether the level of all points wanders from frame to frame, and shutters set it back", find)
