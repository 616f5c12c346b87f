"""Air that carries heat away."""

from __future__ import annotations

from dataclasses import replace

from heatsplat.effects import weather_record
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.weathered import NO_BALANCE, PART_SIGMAS, judged, told_of_water


def evidence(inspected: Inspection) -> Evidence:
    """Whether balances of heat whose exchange grows with the wind explain images better that they were not fitted to."""
    weather = inspected.scene.weather
    if weather.wind_m_s is None or weather.air_c is None:
        return Evidence(None, "the record has no wind, or no air temperature")
    found = judged(inspected.weathered, "convection", inspected.obs.why or NO_BALANCE)
    return replace(found, reason=found.reason + told_of_water(inspected))


EFFECT = Effect(
    name="convection",
    stage="state",
    place=5,
    summary="convection by air, stronger in wind",
    source="ThermoGS, Eq. 2",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="convection does not depend on wind",
    threshold=PART_SIGMAS,
    adds="a wind-dependent exchange with the air, one driver",
    evidence=evidence,
    part=Part("state", "energy_balance", off={"wind": False}),
    stands_on="relaxation",
    displaces=weather_record.INSTEAD,
)
