"""The effect mirrored_sky: a part of the path of heat, on where it is asked for."""

from types import SimpleNamespace

from heatsplat.composition import compose
from heatsplat.effects import assembly
from heatsplat.effects.base import Verdict
from heatsplat.effects.physical.mirrored_sky import EFFECT


def test_it_is_the_first_thing_that_heat_meets():
    found = {
        name: Verdict(name, name in ("mirrored_sky", "attenuation"), None, None, "asked") for name in assembly.NAMES
    }
    thermal = assembly.assemble(assembly.reconcile(found), compose(["method=auto"])["effects"])["thermal"]
    assert list(thermal["parts"]) == ["mirrored_sky", "attenuation"]
    assert thermal["parts"]["mirrored_sky"]["_target_"] == "heatsplat.thermal.mirrored_sky.MirroredSky"


def test_without_a_record_nothing_is_told():
    evidence = EFFECT.evidence(SimpleNamespace(weathered=None, obs=SimpleNamespace(why="")))
    assert not evidence.told and "no record" in evidence.reason
