"""Sky that is hidden by what stands around."""

from __future__ import annotations

from functools import partial

from heatsplat.effects.base import Effect, Part
from heatsplat.effects.weather_record import directed
from heatsplat.effects.weathered import SIGMAS, SKY_VIEW, around

EFFECT = Effect(
    name="sky_view",
    stage="state",
    place=8,
    summary="parts of the sky hidden by the scene",
    source="sky view factor (Oke 1987), from the splatted depth of the scene",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="hidden sky is not visible",
    threshold=SIGMAS,
    adds="a share for each Gaussian",
    evidence=partial(around, name=SKY_VIEW),
    part=Part("state", "energy_balance", off={"sky_view": False}),
    stands_on="solar",
    missing=directed,
)
