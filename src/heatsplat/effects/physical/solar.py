"""Sunlight that a surface absorbs."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.effects import weather_record
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.joint.fit import FLOOR, Fit
from heatsplat.effects.joint.least_squares import own_part


def evidence(inspected: Inspection) -> Evidence:
    """Whether what points do follows the sunlight of the record, over and above the air."""
    weather = inspected.scene.weather
    if weather.irradiance_w_m2 is None or float(weather.irradiance_w_m2.max()) <= 0:
        return Evidence(None, "the record has no irradiance, or the sun does not shine in it")
    if inspected.joint is None:
        return Evidence(None, inspected.obs.why)
    gain = explained(
        inspected.joint[0], weather_record.drivers(inspected.obs), weather_record.of_the_air(inspected.obs)
    )
    return Evidence(gain, f"sunlight explains {gain:.1f} times what its numbers for each point cost, beside the air")


def explained(fit: Fit, more: Tensor, less: Tensor) -> float:
    """What courses over time [F, k], one weight for each point, gain over fewer of them (see ``Fit.gain``)."""
    values = fit.data.tracks.values
    level = torch.ones(fit.data.frames, 1, dtype=more.dtype)
    criteria, costs = [], []
    for courses in (less, more):
        basis = torch.cat([level, courses], 1).expand(len(values), -1, -1)
        left = values - own_part(basis, values, fit.weights)
        counts = (fit.weights > 0).sum(1)
        used = counts > basis.shape[2] + 1
        variance = ((fit.weights * left**2).sum(1)[used] / (counts[used] - basis.shape[2])).clamp_min(FLOOR)
        costs.append(float((basis.shape[2] * counts[used].double().log()).sum()))
        criteria.append(float((counts[used] * variance.log()).sum()))
    cost = costs[1] - costs[0]
    return (criteria[0] - criteria[1]) / cost if cost > 0 else 0.0


EFFECT = Effect(
    name="solar",
    stage="state",
    place=2,
    summary="sunlight that a surface absorbs",
    source="ThermoGS, Eq. 4",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="temperatures follow the air, not the irradiance",
    # Twice what the numbers cost. From 5.2 with it; no recording has weather without sun.
    threshold=2.0,
    adds="an absorptivity for each Gaussian, one driver",
    evidence=evidence,
    part=Part("state", "energy_balance", off={"sun": False}),
    stands_on="relaxation",
    displaces=weather_record.INSTEAD,
)
