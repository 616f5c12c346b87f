"""Sunlight that a surface absorbs."""

from __future__ import annotations

from dataclasses import replace

from heatsplat.effects import weather_record
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.weathered import NO_BALANCE, NO_SUN, PART_SIGMAS, judged, water_on


def evidence(inspected: Inspection) -> Evidence:
    """Whether balances of heat with the sunlight of the record explain images better that they were not fitted to."""
    weather = inspected.scene.weather
    if weather.irradiance_w_m2 is None or float(weather.irradiance_w_m2.max()) <= 0:
        return Evidence(None, NO_SUN)
    found = judged(inspected.weathered, "solar", inspected.obs.why or NO_BALANCE)
    return replace(found, settings=water_on(inspected))


EFFECT = Effect(
    name="solar",
    stage="state",
    place=3,
    summary="absorbed sunlight",
    source="ThermoGS, Eq. 4",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="temperatures follow the air, not the irradiance",
    threshold=PART_SIGMAS,
    adds="an absorptivity for each Gaussian, one driver",
    evidence=evidence,
    part=Part("state", "energy_balance", off={"sun": False}),
    stands_on="relaxation",
    displaces=weather_record.INSTEAD,
)
