"""What surfaces see of sun and sky: the directions in which it is asked, and what comes of the answers.

**Convention:** directions are unit vectors towards sun or sky in the world's axes; of an answer, 1 is open and 0 is hidden.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from heatsplat.contracts import Weather

CELL, BEHIND = 1.5, 4.0  # side of a cell and least distance of what hides a point, in distances between points
APART = math.radians(1.25)  # of directions of the sun: five minutes of its way
MOST = 1024  # such directions, each a map before training and a number for every Gaussian; beyond, they lie wider apart
WIDER = 2.0**0.5
# Of the sun longer before an image than any but massive bodies remember: a year has 260 directions that far apart, and 2,600 that
# are APART. Hours without an image near them are only rendered after training.
PAST_S, PAST_APART = 7 * 86400.0, math.radians(4.0)


def sun_directions(sun: Tensor, up: Tensor, apart: float = APART, known: Tensor | None = None) -> Tensor:
    """Directions [D, 3] such that each that the sun [T, 3] has above the horizon [up: 3] is within an angle of one; up alone
    where it never rises.

    Args:
        apart: the angle in radians, 1.25 degrees.
        known: [K, 3] directions that there are already, which come first.
    """
    risen = sun[sun @ up.to(sun) > 0]
    count = 0 if known is None else len(known)
    found = torch.cat([risen[:0] if known is None else known, torch.empty_like(risen)])
    for direction in risen:
        if not count or float((found[:count] @ direction).max()) < math.cos(apart):
            found[count] = direction
            count += 1
    return found[:count].clone() if count else up.to(sun)[None]


def felt_directions(weather: Weather, moments_s: Iterable[float | None]) -> Tensor:
    """Directions [D, 3] that stand for those of the sun in a record, as far as images at ``moments_s`` feel its shadows.

    Where it stood within a week before an image it is within 1.25 degrees of one of them, or, where that were more than 1024,
    within the least of 1.8, 2.5, ... degrees that are not; at all other times within 4 degrees. Where no image has a time, all
    of the record counts as near one.
    """
    times, moments = weather.times_s, sorted({moment for moment in moments_s if moment is not None})
    near = torch.full_like(times, not moments, dtype=torch.bool)
    for moment in moments:
        first, last = torch.searchsorted(times, torch.tensor([moment - PAST_S, moment], dtype=times.dtype)).tolist()
        near[max(first - 1, 0) : last + 1] = True
    apart = APART
    found = sun_directions(weather.sun[near], weather.up, apart)
    while len(found) > MOST and apart < PAST_APART:
        apart = min(WIDER * apart, PAST_APART)
        found = sun_directions(weather.sun[near], weather.up, apart)
    if near.all():
        return found
    risen = bool((weather.sun[near] @ weather.up.to(weather.sun) > 0).any())
    return sun_directions(weather.sun, weather.up, PAST_APART, found if risen else None)


def sky_directions(count: int, up: Tensor) -> Tensor:
    """Directions [count, 3] float64 above the horizon that stand for equal parts of the hemisphere (a spiral)."""
    number = torch.arange(count, dtype=torch.float64)
    height, angle = (number + 0.5) / count, number * math.pi * (3.0 - 5.0**0.5)
    level = (1.0 - height**2).sqrt()
    aside = torch.linalg.svd(up.double()[None]).Vh[1:]
    return height[:, None] * up + level[:, None] * (angle.cos()[:, None] * aside[0] + angle.sin()[:, None] * aside[1])


def open_share(normals: Tensor, directions: Tensor, seen: Tensor) -> Tensor:
    """Share [N] of the sky's light that reaches surfaces with normals [N, 3], of what they would get without obstacles.

    The sky is equally bright all over; ``seen`` [N, K] says which parts of it are open, along directions [K, 3].
    """
    weights = (normals @ directions.T.to(normals)).clamp(min=0.0)
    return (weights * seen).sum(1) / weights.sum(1).clamp(min=1e-6)


def lit_beside(points: Tensor, others: Tensor, directions: Tensor) -> Tensor:
    """Which points [P, 3] are lit from directions [D, 3] where others [Q, 3] stand in the way: [P, D] of 1 and 0.

    Others count as squares across the light, 1.5 times as wide as they are apart in the median, those at one place counting
    once; a surface does not shade itself: what lies within four such distances hides nothing. The scene's splatted depth
    (``training.exposure``) is finer.
    """
    far = torch.from_numpy(cKDTree(others.unique(dim=0).numpy()).query(points.numpy(), k=2)[0])
    apart = torch.where(far > 0, far, math.inf).amin(1).median()
    found = []
    for direction in directions:
        aside = torch.linalg.svd(direction[None]).Vh[1:].T
        places = torch.cat([others @ aside, points @ aside]) / (CELL * apart)
        # Only cells that hold points are numbered: between far points there are more than memory holds.
        across, along = (line.unique(return_inverse=True)[1] for line in (places - places.amin(0)).long().T)
        cells = (across * len(places) + along).unique(return_inverse=True)[1]
        nearest = torch.full((len(places),), -math.inf, dtype=points.dtype)
        nearest.scatter_reduce_(0, cells[: len(others)], others @ direction, "amax")
        found.append((nearest[cells[len(others) :]] - points @ direction <= BEHIND * apart).to(points))
    return torch.stack(found, 1) if found else points.new_zeros(len(points), 0)
