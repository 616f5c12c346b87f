"""Long waves to and from the sky."""

from __future__ import annotations

from dataclasses import replace

from heatsplat.effects import weather_record
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.weathered import NO_BALANCE, PART_SIGMAS, judged, told_of_clouds, water_on


def evidence(inspected: Inspection) -> Evidence:
    """Whether balances of heat with the sky's long waves explain images better that they were not fitted to.

    Air and sun alone leave no surface colder than the air has been. How far T⁴ departs from a straight line over the span of
    temperatures only says how to solve the balance.
    """
    obs = inspected.obs
    found = judged(inspected.weathered, "radiation", obs.why or NO_BALANCE)
    if obs.tracks is None:
        return found
    bent, weathered = weather_record.bent(obs), inspected.weathered
    nodes = 1 if weathered is None else weathered.nodes
    settings = {"solution": "corrected" if bent else "linear", "nodes": nodes} | water_on(inspected)
    settings["clouds"] = weathered is not None and weathered.clouded
    return replace(found, reason=found.reason + told_of_clouds(weathered), settings=settings)


EFFECT = Effect(
    name="radiation",
    stage="state",
    place=4,
    summary="long-wave radiation to and from the sky",
    source="ThermoGS, Eq. 3",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="temperatures follow air and sun, not the sky",
    threshold=PART_SIGMAS,
    adds="an emissivity for each Gaussian, one driver",
    evidence=evidence,
    part=Part("state", "energy_balance", off={"sky": None, "clouds": False}),
    stands_on="relaxation",
    displaces=weather_record.INSTEAD,
)
