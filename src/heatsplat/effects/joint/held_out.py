"""What an effect is worth on observations that it was not fitted to, and what chance would make of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.model import Model
from heatsplat.effects.observations import MAX_FRAMES

CHANCE = 0.5  # standard errors below which a gain is as good as none; it counts as so many where frames are asked for
# Each fold leaves out a quarter: of every image one half of the points, together with the other half of the image after next.
FOLDS = 4
WORST = 25.0  # squares of the expected error that a missed observation counts at most
NEGLIGIBLE = 1e-9
NOTHING_DB, NOTHING_SIGMAS = 0.1, 1.0  # below either of which there is nothing


@dataclass(frozen=True)
class HeldOut:
    """What one model gains over another on held-out observations.

    Args:
        db: ratio of their mean squared errors, in decibels.
        sigmas: mean over the images of what it gains, in standard errors of that mean.
        images: how many there are.
    """

    db: float
    sigmas: float
    images: int

    def exceeds(self, db: float, sigmas: float) -> bool:
        """Whether it is more than so many decibels, and more than so many standard errors."""
        return self.db > db and self.sigmas > sigmas


def fold_of(points: int, frames: int) -> Tensor:
    """In which fold an observation is left out, [P, F]."""
    return (torch.arange(frames) + FOLDS // 2 * torch.arange(points)[:, None]) % FOLDS


def squares_of(fit: Fit, model: Model) -> Tensor:
    """Squared errors [P, F] of a model at observations that it was not fitted to, in squares of those that are expected."""
    fold = fold_of(*fit.weights.shape)
    squares = torch.zeros_like(fit.weights)
    for k in range(FOLDS):
        left = replace(fit, weights=fit.weights * (fold != k), bases={}).residuals(model)
        squares = torch.where(fold == k, (left / fit.errors) ** 2 / fit.trust[:, None], squares)
    return squares.clamp(max=WORST)


def compared(more: Tensor, less: Tensor, weights: Tensor) -> HeldOut:
    """What squared errors ``more`` [P, F] have over ``less`` where ``weights`` [P, F] count."""
    used = (weights > 0).double()
    seen = used.sum(0) > 0
    each = ((less - more) * used).sum(0)[seen] / used.sum(0)[seen]
    error = float(each.std()) / math.sqrt(len(each)) + NEGLIGIBLE if len(each) > 1 else math.inf
    before, after = (max(float((used * one).sum()), NEGLIGIBLE) for one in (less, more))
    return HeldOut(10.0 * math.log10(before / after), float(each.mean()) / error, len(each))


def shows(gain: HeldOut) -> bool:
    """Whether what is gained on held-out observations may be more than nothing."""
    return gain.exceeds(NOTHING_DB, NOTHING_SIGMAS)


def would_tell(gain: HeldOut, sigmas: float) -> str:
    """Frames from which a gain that scatters as it does would be so many standard errors, in words; of a longer record no more
    than MAX_FRAMES are looked at."""
    needed = math.ceil(gain.images * (sigmas / max(gain.sigmas, CHANCE)) ** 2)
    if needed > MAX_FRAMES:
        return f"less noise would tell, for no more than {MAX_FRAMES} frames are looked at"
    return f"about {needed} frames would tell"


def shuffled(fit: Fit, less: Model, generator: torch.Generator, together: bool) -> Fit:
    """The state of observations whose departures from a model change places among the images that see their point.

    Times, directions and places in the image then have nothing to do with what departs from the model.

    Args:
        fit: linearised about the model.
        less: the model.
        generator: draws the order.
        together: all points in one order of the images; False: each point in its own, so that no image has anything in common.
    """
    points, frames = fit.weights.shape
    left, unseen = fit.residuals(less), (fit.weights <= 0) * 2.0
    keys = torch.rand(1 if together else points, frames, generator=generator, dtype=torch.float64).expand(points, -1)
    # The images that see a point, in order; then the others.
    there = (torch.arange(frames) / frames + unseen).argsort(1)
    order = (keys + unseen).argsort(1)  # the same, shuffled
    moved = torch.zeros_like(left).scatter(1, there, (left / fit.errors).gather(1, order)) * fit.errors
    values = fit.data.tracks.values - left + torch.where(fit.weights > 0, moved, left)
    data = replace(fit.data, tracks=replace(fit.data.tracks, values=values))
    return replace(fit, data=data, bases={})
