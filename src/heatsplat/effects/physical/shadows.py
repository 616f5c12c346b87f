"""Shadows that are cast within a scene."""

from __future__ import annotations

from functools import partial

from heatsplat.effects.base import Effect, Part
from heatsplat.effects.weather_record import directed
from heatsplat.effects.weathered import SHADOWS, SIGMAS, around

EFFECT = Effect(
    name="shadows",
    stage="state",
    place=7,
    summary="shadows cast by the scene",
    source="Williams (1978), with the splatted depth of the scene",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="shadows are not visible",
    threshold=SIGMAS,
    adds="a share for each Gaussian and direction of the sun",
    evidence=partial(around, name=SHADOWS),
    part=Part("state", "energy_balance", off={"shadows": False}),
    stands_on="solar",
    missing=directed,
)
