"""Air that carries heat away."""

from __future__ import annotations

import torch

from heatsplat.effects import weather_record
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection


def evidence(inspected: Inspection) -> Evidence:
    """Whether the wind of the record can change temperatures by more than the noise hides.

    The record and the size of temperatures say so, not their course: wind is there, and what it does is a matter of scale.
    With h = 5 + 3 v (McAdams' order of magnitude), a surface that is D above the air in equilibrium is off by D · Δh / h
    when the wind is taken to be its mean.
    """
    weather, obs = inspected.scene.weather, inspected.obs
    if weather.wind_m_s is None or weather.air_c is None:
        return Evidence(None, "the record has no wind, or no air temperature")
    if obs.tracks is None or obs.times_s is None:
        return Evidence(None, obs.why)
    wind = weather_record.at(weather, weather.wind_m_s, obs.times_s)
    air = inspected.scene.thermal_range.to_unit(weather_record.at(weather, weather.air_c, obs.times_s))
    exchange = 5.0 + 3.0 * wind
    change = (exchange - exchange.mean()) / exchange.mean()
    above = torch.where(obs.tracks.weights > 0, obs.tracks.values - air, torch.nan)
    moved = (above * change).abs().nan_to_num(0.0)
    typical = float(torch.quantile(moved[moved > 0], 0.9)) if bool((moved > 0).any()) else 0.0
    return Evidence(
        typical / (3.0 * obs.noise),
        f"wind of {float(wind.min()):.1f} to {float(wind.max()):.1f} m/s changes the exchange by up to "
        f"{100 * float(change.abs().max()):.0f} %, worth {obs.size(typical)} of what surfaces are above the air",
    )


EFFECT = Effect(
    name="convection",
    stage="state",
    place=4,
    summary="air that carries heat away, faster in wind",
    source="ThermoGS, Eq. 6, 7",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="what the recorded wind changes of surfaces' excess over the air is below the noise",
    # The change is three times the noise. From 7.0 with it; no recording has weather without wind.
    threshold=1.0,
    adds="exchange with the air that depends on wind, one driver",
    evidence=evidence,
    part=Part("state", "energy_balance", off={"wind": False}),
    stands_on="relaxation",
    displaces=weather_record.INSTEAD,
)
