"""The effect shadows: on where it is asked for, and refused where the weather does not say from where light comes."""

from types import SimpleNamespace

import torch

from heatsplat.composition import compose
from heatsplat.effects import assembly
from heatsplat.effects.base import Verdict
from heatsplat.effects.physical.shadows import EFFECT


def test_it_is_there_where_it_is_asked_for_and_brings_the_sun():
    found = {other: Verdict(other, other == EFFECT.name, None, None, "asked") for other in assembly.NAMES}
    on = assembly.reconcile(found)
    assert {"solar", EFFECT.name} <= {name for name in on if on[name].on}
    templates = compose(["method=auto"])["effects"]
    state = assembly.assemble(on, templates)["thermal"]["state"]
    without = assembly.assemble(assembly.without(on, EFFECT.name), templates)["thermal"]["state"]
    assert (state["shadows"], without["shadows"]) == (True, False)
    assert {key for key in state if state[key] != without[key]} == {"shadows"}


def test_it_needs_to_know_from_where_light_comes():
    series = torch.ones(2)
    weather = SimpleNamespace(sun=series, direct_w_m2=series, diffuse_w_m2=series)
    assert EFFECT.missing(SimpleNamespace(weather=weather)) is None
    weather.sun = None
    assert "lacks sun" in EFFECT.missing(SimpleNamespace(weather=weather))
    assert EFFECT.evidence(None).told is False
