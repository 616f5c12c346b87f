"""Points that change at moments of their own: a hot thing passes them, one after the other, and each cools again afterwards."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.effects.joint.data import MIN_FREE
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.model import Model
from heatsplat.training.rng import generator_for

# After a moment a change fades at one of these rates, times the record's length; outliers at single frames are quicker.
FADING = (3.0, 10.0)
SHUFFLES = 20  # of a point's departures, the best of which a moment has to beat
LARGE = 2.0  # expected errors, root mean square over a point's observations, below which a change counts for nothing
LASTS = 3  # frames in which a change shows, at the least
FREE = 1e-3  # share of a course's length that a point's other numbers must leave of it


def share_of_points(fit: Fit, model: Model) -> float:
    """Share of the points that change by much at a moment of their own, and the same way, over the share that do by chance.

    What a model leaves of a point's values is explained by one change at one moment that fades afterwards. It counts where it
    explains more than the best moment of every one of 20 shuffles of what is left; by chance 1 in 21 points does. Where images
    follow each other closely more do, as what a misplaced point shows goes on from image to image, too, in no order that a
    shuffle keeps: that is warmer as often as colder, so points that change one way count against those that change the other,
    and are compared with the half of those by chance that change their way.

    Args:
        fit: its outliers count here, for a point that something passes looks like one.
        model: that explains the points otherwise, with a course over time for each.
    """
    data, seen = fit.data, fit.data.tracks.weights > 0
    values, basis = fit.own(model)
    values = values - sum(fit.contributions(model).values())
    counted = seen.sum(1) >= basis.shape[2] + 2 * MIN_FREE
    if not counted.any():
        return 0.0
    seen, root = seen[counted], (data.tracks.weights.sqrt() / fit.errors)[counted, :, None]
    known, _ = torch.linalg.qr(_unit(root * basis[counted]))
    left = _tamed(_without(known, root * values[counted, :, None]))
    courses = root * _changes(data.passed)
    free = _without(known, courses)
    told = free.norm(dim=1, keepdim=True) > FREE * courses.norm(dim=1, keepdim=True)
    free = _unit(free) * told

    def explained(rest: Tensor) -> tuple[Tensor, Tensor]:
        """The change of each point at its best moment, as the root of the squares that it explains, and their share of all that
        its other numbers leave."""
        rest = _without(known, rest)
        changes = (free.mT @ rest)[..., 0]
        best = changes.gather(1, changes.abs().argmax(1, keepdim=True))[:, 0]
        return best, best.square() / rest.square().sum((1, 2)).clamp_min(1e-150)

    found, part = explained(left)
    shuffles = [_shuffled(left, seen, generator_for(0, k, "shuffled moments")) for k in range(SHUFFLES)]
    chance = torch.stack([explained(shuffled)[1] for shuffled in shuffles]).max(0).values
    large = found.square() > LARGE**2 * seen.sum(1)
    return abs(float((found.sign() * (large & (part > chance))).mean())) * 2 * (SHUFFLES + 1)


def _tamed(left: Tensor) -> Tensor:
    """What is left [P, F, 1] with the largest departures of each point no larger than its third: a change lasts, an outlier
    does not."""
    third = left.abs().topk(LASTS, dim=1).values[:, -1:]
    return left.clamp(-third, third)


def _changes(passed: Tensor) -> Tensor:
    """Courses [F, c] of changes that begin between two frames and fade."""
    times = passed.unique()
    since = passed[:, None] - (times[1:] + times[:-1]) / 2
    return torch.cat([torch.where(since > 0, (-rate * since).exp(), 0.0) for rate in FADING], 1)


def _unit(columns: Tensor) -> Tensor:
    return columns / columns.norm(dim=1, keepdim=True).clamp_min(1e-150)


def _without(known: Tensor, columns: Tensor) -> Tensor:
    """Columns [P, F, c] without what orthonormal ones [P, F, k] say."""
    return columns - known @ (known.mT @ columns)


def _shuffled(left: Tensor, seen: Tensor, generator: torch.Generator) -> Tensor:
    """What is left [P, F, 1] in another order over the frames that see each point."""
    unseen = (~seen) * 2.0
    keys = torch.rand(seen.shape, generator=generator, dtype=torch.float64)
    there = (torch.arange(seen.shape[1]) / seen.shape[1] + unseen).argsort(1)
    order = (keys + unseen).argsort(1)
    return torch.zeros_like(left).scatter(1, there[..., None], left.gather(1, order[..., None]))
