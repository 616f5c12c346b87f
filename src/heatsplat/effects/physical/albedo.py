"""Sunlight that the ground sends back."""

from __future__ import annotations

from functools import partial

from heatsplat.effects.base import Effect, Part
from heatsplat.effects.weather_record import directed
from heatsplat.effects.weathered import ALBEDO, SIGMAS, around

EFFECT = Effect(
    name="albedo",
    stage="state",
    place=9,
    summary="sunlight reflected by the ground",
    source="Oke (1987)",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="light from the ground is not visible",
    threshold=SIGMAS,
    adds="one driver",
    evidence=partial(around, name=ALBEDO),
    part=Part("state", "energy_balance", off={"albedo": None}),
    stands_on="solar",
    missing=directed,
)
