"""Evidence of the effects that a weather record drives."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.effects.base import Evidence
from heatsplat.effects.evidence import record
from heatsplat.effects.evidence.joint_fit import joint
from heatsplat.effects.observations import Observations

HURDLE = 2.0
BENT = 1.0  # statistic of radiation above which T⁴ shows as what it is
MEAN_K = 290.0


def solar(obs: Observations) -> Evidence:
    """Whether what points do follows the sunlight of the record, over and above the air."""
    weather = obs.scene.weather
    if weather.irradiance_w_m2 is None or float(weather.irradiance_w_m2.max()) <= 0:
        return Evidence(None, "the record has no irradiance, or the sun does not shine in it")
    found = joint(obs)
    if found is None:
        return Evidence(None, obs.why)
    gain = found[0].explained(record.drivers(obs), record.of_the_air(obs))
    return Evidence(gain, f"sunlight explains {gain:.1f} times what its numbers for each point cost, beside the air")


def radiation(obs: Observations) -> Evidence:
    """Whether T⁴ departs from a straight line over the span of temperatures by more than the noise.

    For a surface at T about a mean M: the excess over the line is (T - M)² · 3 / (2 M) to second order, in kelvin.
    """
    if obs.tracks is None:
        return Evidence(None, obs.why)
    kept = torch.where(obs.tracks.weights > 0, obs.tracks.values, torch.nan)
    span_k = _span(kept) * obs.unit_k
    bend_k = 1.5 * (0.5 * span_k) ** 2 / MEAN_K
    statistic = bend_k / (3.0 * obs.noise * obs.unit_k)
    return Evidence(
        statistic,
        f"surfaces go through {span_k:.1f} K, over which T⁴ departs from a line by the worth of {bend_k:.2f} K; three times "
        f"the noise is {3 * obs.noise * obs.unit_k:.2f} K",
        {"solution": "corrected" if statistic > BENT else "linear"},
    )


def convection(obs: Observations) -> Evidence:
    """Whether the wind of the record can change temperatures by more than the noise hides.

    The record and the size of temperatures say so, not their course: wind is there, and what it does is a matter of scale.
    With h = 5 + 3 v (McAdams' order of magnitude), a surface that is D above the air in equilibrium is off by D · Δh / h
    when the wind is taken to be its mean.
    """
    weather = obs.scene.weather
    if weather.wind_m_s is None or weather.air_c is None:
        return Evidence(None, "the record has no wind, or no air temperature")
    if obs.tracks is None or obs.times_s is None:
        return Evidence(None, obs.why)
    wind = record.at(weather, weather.wind_m_s, obs.times_s)
    air = obs.scene.thermal_range.to_unit(record.at(weather, weather.air_c, obs.times_s))
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


def _span(values: Tensor) -> float:
    """Range over time [P, F] (nan where not seen) that a tenth of the points exceed."""
    low = torch.nan_to_num(values, nan=torch.inf).amin(1)
    high = torch.nan_to_num(values, nan=-torch.inf).amax(1)
    return float((high - low)[(high > low)].quantile(0.9)) if bool((high > low).any()) else 0.0
