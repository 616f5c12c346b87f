"""Evidence that comes out of the joint fit."""

from __future__ import annotations

from collections.abc import Collection

from heatsplat.contracts import rounded
from heatsplat.effects.base import Evidence
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.certainty import Certainty
from heatsplat.effects.joint.model import Model
from heatsplat.effects.joint.selection import candidates, earns, worthwhile

WELL_OUTDONE = 1.0  # share of others' size below which an effect makes up for what they lack


def gained(inspected: Inspection, name: str, sentence: str) -> Evidence:
    """What an effect gains in the presence of those that were selected."""
    if inspected.joint is None:
        return Evidence(None, inspected.obs.why or "no point can be followed through the images")
    fit, model = inspected.joint
    certainty = inspected.certainty
    if name in model.names:
        return judged(certainty, name, sentence, model, fit.without(model, name))
    if name in certainty.doubts:
        return Evidence(None, f"cannot be told: {certainty.doubts[name]}", told=False)
    tried = [one for other, one in candidates(fit, model) if other == name]
    if few := certainty.few(name):
        return Evidence(None, f"cannot be told: {few}", told=False)
    if not tried:
        why = fit.data.effects[name].term.unseen(fit.data)
        return Evidence(None, f"the training views do not allow to look for it: {why}")
    best = max(tried, key=lambda one: fit.gain(one, model))
    gain, size = fit.gain(best, model), fit.effect_size(best, model)
    if gain > 1.0 and certainty.unseen_changes and not certainty.explained:
        return Evidence(gain, f"{sentence} {beside(size)}: cannot be told, {certainty.unseen_changes}", told=False)
    if gain > 1.0 and not worthwhile(fit, best, model, name):
        if certainty.clear(best, name):
            why = "it may be how the model of the scene's changes errs; more frames would tell"
            return Evidence(gain, f"{sentence} {beside(size)}: cannot be told, {why}", told=False)
        return Evidence(0.0, f"{sentence} {beside(size)}, too little beside the noise or the changes of the scene")
    if earns(fit, best, model, name):
        return Evidence(0.0, f"{sentence} {beside(size)}, which the effects that are on explain as well")
    found = f"{sentence} {beside(size)}; {gain:.1f} times what its parameters cost"
    told = not certainty.undecided(best, name)
    return Evidence(gain, found if told else f"{found}: cannot be told, more frames would tell", told=told)


def judged(certainty: Certainty, name: str, sentence: str, more: Model, less: Model) -> Evidence:
    """What an effect gains that was taken in, and whether that can be told from chance."""
    gain, size = certainty.fit.gain(more, less), certainty.fit.effect_size(more, less)
    worth = certainty.worth(name, more, less)
    doubt = certainty.told.get(name, worth.doubt) or certainty.doubts.get(name, "")
    found = f"{sentence} {beside(size)}; {gain:.1f} times what its parameters cost, {worth.held_out.db:.1f} dB where left out"
    if certainty.idle(name, more, less):
        return Evidence(0.0, f"{found}: nothing is lost without it", gain_db=worth.held_out.db)
    return Evidence(
        gain, f"{found}: cannot be told, {doubt}" if doubt else found, told=not doubt, gain_db=worth.held_out.db
    )


def selected_kind(inspected: Inspection, name: str) -> object | None:
    """In which kind the joint fit selected an effect; None where it did not, or there is none."""
    return None if inspected.joint is None else inspected.joint[1].kind(name)


def outdone(inspected: Inspection, name: str, others: Collection[str]) -> bool:
    """Whether an effect was only taken in beside others that explain the same kind of change, and more of it."""
    if inspected.joint is None or not {name, *others} <= inspected.joint[1].names:
        return False
    fit, model = inspected.joint
    less = fit.without(model, name)
    size = fit.effect_size(model, less)
    return all(size < WELL_OUTDONE * fit.effect_size(less, fit.without(less, other)) for other in others)


def beside(size: float) -> str:
    """The size of an effect in words."""
    return f"{rounded(size, 2)} times the error expected of an observation"
