"""The effect shadows: on where it is asked for, and refused where the weather does not say from where light comes."""

from effects.asked_for import asked_for, lacks, told

from heatsplat.effects.physical.shadows import EFFECT


def test_it_is_there_where_it_is_asked_for_and_brings_the_sun():
    on, settings = asked_for(EFFECT)
    assert {"solar", "shadows"} <= on
    assert settings == {"shadows": (True, False)}


def test_it_needs_to_know_from_where_light_comes():
    assert lacks(EFFECT) is None
    assert "lacks sun" in lacks(EFFECT, sun=None)
    evidence = told(EFFECT, parts=("solar",))
    assert not evidence.told and "from where light comes" in evidence.reason
    assert "does not shine" in told(EFFECT, parts=("radiation",)).reason
