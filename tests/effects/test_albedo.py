"""The effect albedo: on where it is asked for, and refused where the weather does not say from where light comes."""

from effects.asked_for import brings_the_sun, needs_directed_light

from heatsplat.effects.physical.albedo import EFFECT


def test_it_is_there_where_it_is_asked_for_and_brings_the_sun():
    brings_the_sun(EFFECT, 0.2, None)


def test_it_needs_to_know_from_where_light_comes():
    needs_directed_light(EFFECT)
