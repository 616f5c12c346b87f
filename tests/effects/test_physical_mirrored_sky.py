"""The effect mirrored_sky: a part of the path of heat, on where it is asked for."""

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
    assert EFFECT.evidence(None).told is False
