"""One robust fit of all effects together: each has to earn its parameters in the presence of the others.

Starting from levels alone, the effect that lowers the Bayesian information criterion

    n log(weighted squares / n) + parameters · log n

most is taken in until none lowers it, and effects that the others make needless are dropped again. Effects that look
alike one by one (a common offset and heating, gain steps and haze, a fixed pattern and vignetting) are told apart by
which of them explains more with less. The criterion needs no noise level; how large an effect is beside the noise is
asked afterwards.
"""

from __future__ import annotations

from collections.abc import Collection

from heatsplat.effects.joint.courses import ANY
from heatsplat.effects.joint.fit import Fit
from heatsplat.effects.joint.like_heat import is_heat
from heatsplat.effects.joint.model import Model

# Share of the changes that any effect must exceed where a weather record, whose answers are rough, explains them.
BESIDE_WEATHER = 0.2
MAX_STEPS = 12
MOST = 0.8  # share of what many numbers explain at the usual point from which few make do


def selected(start: Fit) -> tuple[Fit, Model]:
    """The fit that accepted the model that explains most with least, and that model.

    Effects are taken in one at a time, from several starts: from nothing, those of the sensor first; from nothing, whichever
    explains most; and from what effects themselves name, such as a driven scene before an uneven camera. A change of all
    points in common is cheap as an offset and dear as courses of every point, but the courses explain more at once; and
    where a source and a pattern are at work, neither explains much alone: only the ends of the ways tell which was right.
    """
    effects = start.data.effects
    early = [name for name, effect in effects.items() if effect.term.sensor_first]
    named = [begin for effect in effects.values() for begin in effect.term.starts(start.data)]
    ends = []
    for begin, first in [(Model(), early), (Model(), ()), *((begin, ()) for begin in named)]:
        fit = start
        if begin.names:
            fit = fit.accepted(begin).accepted(begin)
            if not begin.names <= pruned(fit, begin).names:
                continue
        fit, model = grown(fit, begin, first)
        _, model = grown(fit, model, effects)
        if model not in ends:
            ends.append(model)
    model = min(ends, key=lambda end: start.linearised(end).linearised(end).quality(end).bic)
    model = given_way(start, model)
    fit = start.accepted(model).accepted(model)
    fit, model = grown(fit, pruned(fit, model), effects)
    return warmed(start, fit, model)


def given_way(start: Fit, model: Model) -> Model:
    """The model with effects of few numbers in the place of those of many that explain hardly more.

    Taken in first, those of many would leave nothing for these to explain.
    """
    effects = start.data.effects
    for name in sorted(model.names):
        neither, found = start.without(model, name), []
        for other in (one for one in effects[name].term.gives_way_to if one in effects and one not in model.names):
            for kind in effects[other].term.kinds(start):
                few = neither.plus(other, kind)
                fit = start.accepted(few).accepted(few)
                if makes_do(fit, few, model, neither) and earns(fit, few, neither, other):
                    found.append((fit.quality(few).bic, few))
        model = min(found, key=lambda one: one[0], default=(0.0, model))[1]
    return model


def makes_do(fit: Fit, few: Model, many: Model, neither: Model) -> bool:
    """Whether at the usual point a model of few numbers explains most of what one of many explains.

    Numbers of each point also make up for what is known roughly of what few numbers are about, such as normals at edges. So all
    points together prefer them even where there is nothing else.
    """
    explained, possible = (fit.variances(neither) - fit.variances(one) for one in (few, many))
    shares = (explained / possible)[possible > 0]
    return len(shares) > 0 and float(shares.median()) > MOST


def warmed(start: Fit, fit: Fit, model: Model) -> tuple[Fit, Model]:
    """The model with heat in the place of what single images have in common, where that goes as heat does.

    A number for each image costs less than numbers for each point and explains as much where all points cool alike, but that a
    sensor walks such a way is improbable.
    """
    effects = fit.data.effects
    single = [name for name in model.names if effects[name].term.single_images]
    if not any(is_heat(fit, model, name) for name in single):
        return fit, model
    changing = [name for name, one in effects.items() if one.term.in_time and one.stands_on is None]
    # A curve shows only along what single images have in common.
    beside = model.minus({*single, "tone"})
    for name in changing:
        kinds = effects[name].term.kinds(fit)
        if kinds:
            other = start.accepted(beside.plus(name, kinds[0])).accepted(beside.plus(name, kinds[0]))
            if earns(other, beside.plus(name, kinds[0]), beside, name):
                return grown(other, pruned(other, beside.plus(name, kinds[0])), effects)
    return fit, model


def candidates(fit: Fit, model: Model) -> list[tuple[str, Model]]:
    """Models with one effect more, or one in a larger kind, by its name; what the effect stands on comes with it."""
    found = []
    for name, effect in fit.data.effects.items():
        kinds, kind = list(effect.term.kinds(fit)), model.kind(name)
        if kind is not None:
            kinds = kinds[kinds.index(kind) + 1 :] if kind in kinds else []
        ground = effect.stands_on
        base = model.plus(ground) if ground in fit.data.effects and ground not in model.names else model
        found += [(name, base.plus(name, larger)) for larger in kinds]
    return found


def grown(fit: Fit, model: Model, names: Collection[str]) -> tuple[Fit, Model]:
    """A model with those effects among ``names`` that earn their place, and without those that no longer do."""
    seen = {model}
    for _ in range(MAX_STEPS):
        tried = [(name, more) for name, more in candidates(fit, model) if name in names]
        found = [more for name, more in tried if earns(fit, more, model, name)]
        best = min(found, key=lambda more: fit.quality(more).bic, default=None)
        if best is None or fit.quality(best).bic >= fit.quality(model).bic:
            break
        model = pruned(fit, best)
        fit = fit.accepted(model)
        if model in seen:
            break
        seen.add(model)
    return fit, pruned(fit, model)


def pruned(fit: Fit, model: Model) -> Model:
    """The model without the effects that do not earn their place, the one that gains least first."""
    while True:
        idle = [name for name in sorted(model.names) if not earns(fit, model, fit.without(model, name), name)]
        if not idle:
            return model
        model = fit.without(model, min(idle, key=lambda name: fit.gain(model, fit.without(model, name))))


def earns(fit: Fit, more: Model, less: Model, name: str) -> bool:
    """Whether an effect explains enough for what its parameters cost, and is large enough."""
    return fit.gain(more, less) > fit.data.effects[name].threshold and worthwhile(fit, more, less, name)


def worthwhile(fit: Fit, more: Model, less: Model, name: str) -> bool:
    """Whether what an effect adds is large enough beside the noise, and beside what the scene does by itself: how a
    model of the scene's changes errs is easily taken for a small flaw of the sensor."""
    term, size = fit.data.effects[name].term, fit.effect_size(more, less)
    if size < term.smallest or not all(rule(fit, more, less) for rule in term.rules):
        return False
    for other in less.names.intersection(term.gives_way_to):
        if makes_do(fit, less, more.minus({other}), less.minus({other})):
            return False
    at_rest = fit.at_rest(less)
    rough = fit.data.rough and ANY not in less.names
    share = BESIDE_WEATHER if rough else term.beside_changes
    return at_rest == less or size > share * fit.effect_size(less, at_rest)
