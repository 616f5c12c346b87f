"""What single images have in common may go over time as a scene by itself does: whether it does, and whether by chance."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.effects.joint.courses import ANY
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.model import Model
from heatsplat.training.rng import generator_for

LIKE_HEAT = 0.9  # share of the variance of a course over time that heat explains from which it may be heat
WALKS = 400  # random ones, of which so few are as much like heat as what is taken for heat
BY_CHANCE = 0.01
FREE = 4  # frames that heat's own numbers must leave


def may_be_heat(fit: Fit, model: Model, name: str) -> bool:
    """Whether what an effect of single images adds goes over time as a scene may that, by the model, does not change."""
    heat = _heat(fit, model, name)
    if heat is None:
        return False
    seen = _seen(fit)
    beyond, free = _beyond(_course(fit, model, name)[:, seen], heat[seen])
    return free <= 0 or float(beyond) < 1.0 - LIKE_HEAT


def is_heat(fit: Fit, model: Model, name: str) -> bool:
    """Whether it goes so much as heat would that a sensor, whose level or gain walks at random, hardly ever does.

    What a weather record says of heat is too rough to tell.
    """
    heat = _heat(fit, model, name)
    if heat is None or fit.data.drivers is not None:
        return False
    seen = _seen(fit)
    beyond, free = _beyond(_course(fit, model, name)[:, seen], heat[seen])
    if free < FREE:
        return False
    steps = torch.randn(WALKS, fit.data.frames, generator=generator_for(0, 0, "walks"), dtype=torch.float64)
    in_time = fit.data.times_s.argsort(stable=True)
    walks = torch.empty_like(steps)
    walks[:, in_time] = steps.cumsum(1)
    walks, _ = _beyond(walks[:, seen], heat[seen])
    return float((walks <= beyond).double().mean()) < BY_CHANCE


def _heat(fit: Fit, model: Model, name: str) -> Tensor | None:
    """Courses [F, k] of a scene that changes by itself, with a level; None where the effect is none of single images, and where
    the model has the scene change anyhow."""
    data = fit.data
    if name not in model.names or not data.effects[name].term.single_images or data.span_s <= 0:
        return None
    known = [one for one, e in data.effects.items() if e.term.in_time and one != ANY and not e.term.numbers(data, 1)]
    if not known or set(known) & model.names:
        return None
    ones = torch.ones(data.frames, 1, dtype=torch.float64)
    return torch.cat([ones, *(fit.basis(one, 1) for one in known)], 1)


def _seen(fit: Fit) -> Tensor:
    """Which images [F] say anything of what they have in common."""
    return (fit.weights > 0).any(0)


def _course(fit: Fit, model: Model, name: str) -> Tensor:
    """The course over time [1, F] of what an effect adds to the points, or would add to those that an image does not see: how
    many an image sees is no change of it."""
    added = fit.contributions(model)[name][(fit.weights > 0).any(1)]
    return torch.linalg.svd(added, full_matrices=False).Vh[:1]


def _beyond(courses: Tensor, heat: Tensor) -> tuple[Tensor, int]:
    """Share [n] of the variance of courses [n, F] that heat [F, k] does not explain, and the frames that are free to say so."""
    left = courses.mT - heat @ torch.linalg.lstsq(heat, courses.mT).solution
    free = heat.shape[0] - heat.shape[1]
    return (left**2).sum(0) / max(free, 1) / courses.var(1), free
