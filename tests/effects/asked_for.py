"""What is asked of every effect of the scene's own geometry: there where it is asked for, and told what light it lacks."""

from types import SimpleNamespace

import torch

from heatsplat.composition import compose
from heatsplat.effects import assembly
from heatsplat.effects.base import Effect, Verdict


def asked_for(effect: Effect) -> tuple[set[str], dict[str, tuple]]:
    """The effects that are on where this one alone is asked for, and the settings of the state that differ without it, each with
    its value (with it, without it)."""
    asked = {other: Verdict(other, other == effect.name, None, None, "asked") for other in assembly.NAMES}
    found = assembly.reconcile(asked)
    templates = compose(["method=auto"])["effects"]
    state, without = (
        assembly.assemble(verdicts, templates)["thermal"]["state"]
        for verdicts in (found, assembly.without(found, effect.name))
    )
    on = {name for name in found if found[name].on}
    return on, {key: (state[key], without[key]) for key in state if state[key] != without[key]}


def lacks(effect: Effect, **series: torch.Tensor | None) -> str | None:
    """What a scene lacks whose weather has sun, direct and diffuse light, but for the series that are given."""
    weather = dict.fromkeys(("sun", "direct_w_m2", "diffuse_w_m2"), torch.ones(2)) | series
    return effect.missing(SimpleNamespace(weather=SimpleNamespace(**weather)))


def told(effect: Effect, parts: tuple[str, ...]):
    """The evidence under a weather in which so much of the sky plays a part, and that does not say from where light comes."""
    return effect.evidence(SimpleNamespace(weathered=SimpleNamespace(beside=lambda name: None, parts=parts)))
