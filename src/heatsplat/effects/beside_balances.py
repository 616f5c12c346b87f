"""What a camera does under recorded weather: the joint fit once more, in which points go as their own balances of heat may.

How surfaces answer weather in general explains points to a few times the noise. What is left over all points have in common, as
they have a drifting camera in common, so that nobody can tell which of the two it is. Full balances leave the noise alone.
"""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from heatsplat.effects.full_balance import FullBalance
from heatsplat.effects.joint.data import MIN_FREE
from heatsplat.effects.joint.fit import Fit, fit_of
from heatsplat.effects.joint.least_squares import own_part
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.selection import selected

# Errors expected of an observation by which the usual point misses its balance, with what a camera does, where points follow
# balances: 0.3 to 1.3 on 47 random scenes (tiny), and 1.7 on one. On 13 others frames were too few.
FOLLOWED = 1.5
# By which balances of all points miss an image together, beside what they can make of that themselves: up to 0.2 K in five
# recordings without a sensor that drifts, and from 0.45 K in six with one.
TOGETHER_K = 0.3
# Share of the squares of what a camera adds, beyond a level of each point, from which on balances cannot say it: of random scenes
# 0.06 to 0.7, and below 0.03 in four, in two of which it had grown to 80 and 18 K where the camera makes 2 and 3.
BEYOND = 0.04


def beside_balances(fit: Fit, balances: FullBalance, unit_k: float) -> tuple[Fit, Model] | None:
    """The joint fit in which each point goes as its own full balance may, and the model that it selects of what does not change
    the scene over time; None where frames are too few to tell both, and where points do not follow such balances (ours).

    Args:
        fit: to which the weather record says roughly how surfaces change.
        balances: of its P points in its F frames, temperatures in °C.
        unit_k: kelvin in a unit of the images.
    """
    ways = balances.ways(int(fit.data.usual_length) - MIN_FREE - 2)  # a level and the balance stand beside them
    if ways is None:
        return None
    still = {name: effect for name, effect in fit.data.effects.items() if not effect.term.in_time}
    data = replace(fit.data, effects=still, balances=ways / unit_k, balances_err=TOGETHER_K / unit_k)
    fit, model = selected(fit_of(data))
    seen = (fit.weights > 0).any(1)
    followed = bool(seen.any()) and float(fit.variances(model)[seen].median().sqrt()) < FOLLOWED
    return (fit, model) if followed else None


def beyond_balances(fit: Fit, model: Model, added: Tensor) -> Tensor:
    """What is certain of what a camera adds [P, F] beside balances: all of it; where they could say nearly all of it, what they
    cannot. How much of the rest is heat nobody knows, and to leave some of the camera in is the smaller error."""
    basis, used = fit.own(model)[1], fit.weights > 0
    level, beyond = (added - own_part(own, added, fit.weights) for own in (basis[..., :1], basis))
    left, whole = ((fit.weights * one**2)[used].sum() for one in (beyond, level))
    return beyond if left < BEYOND * whole else added
