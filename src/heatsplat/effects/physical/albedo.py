"""Sunlight that the ground sends back."""

from __future__ import annotations

from heatsplat.effects.base import Effect, Part
from heatsplat.effects.weather_record import NEVER, directed, only_if_asked

EFFECT = Effect(
    name="albedo",
    stage="state",
    place=9,
    summary="sunlight that comes back from the ground",
    source="Oke (1987)",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="what the ground sends back does not show",
    threshold=NEVER,
    adds="one driver",
    evidence=only_if_asked,
    part=Part("state", "energy_balance", off={"albedo": None}),
    stands_on="solar",
    missing=directed,
)
