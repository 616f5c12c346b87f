"""What holds of every effect of the scene's own geometry: on where it is asked for, and refused without directed light."""

from types import SimpleNamespace

import torch

from heatsplat.composition import compose
from heatsplat.effects import assembly
from heatsplat.effects.base import Effect, Verdict


def brings_the_sun(effect: Effect, on: object, off: object) -> None:
    """Where it is asked for, the sun comes with it, and of the state's settings its own alone differs: ``on`` for ``off``."""
    asked = {other: Verdict(other, other == effect.name, None, None, "asked") for other in assembly.NAMES}
    found = assembly.reconcile(asked)
    assert {"solar", effect.name} <= {name for name in found if found[name].on}
    templates = compose(["method=auto"])["effects"]
    state = assembly.assemble(found, templates)["thermal"]["state"]
    without = assembly.assemble(assembly.without(found, effect.name), templates)["thermal"]["state"]
    assert (state[effect.name], without[effect.name]) == (on, off)
    assert {key for key in state if state[key] != without[key]} == {effect.name}


def needs_directed_light(effect: Effect) -> None:
    """Weather that does not say from where light comes is named, and then no image tells the effect."""
    series = torch.ones(2)
    weather = SimpleNamespace(sun=series, direct_w_m2=series, diffuse_w_m2=series)
    assert effect.missing(SimpleNamespace(weather=weather)) is None
    weather.sun = None
    assert "lacks sun" in effect.missing(SimpleNamespace(weather=weather))
    nowhere = SimpleNamespace(beside=lambda name: None, parts=("solar",))
    evidence = effect.evidence(SimpleNamespace(weathered=nowhere))
    assert not evidence.told and "from where light comes" in evidence.reason
    night = SimpleNamespace(parts=("radiation",))
    assert "does not shine" in effect.evidence(SimpleNamespace(weathered=night)).reason
