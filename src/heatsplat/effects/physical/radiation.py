"""Long waves to and from the sky."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from heatsplat.effects import weather_record
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.weathered import NO_BALANCE, SIGMAS, judged

MEAN_K = 290.0


def evidence(inspected: Inspection) -> Evidence:
    """Whether balances of heat with the sky's long waves explain images better that they were not fitted to.

    Air and sun alone leave no surface colder than the air has been. How far T⁴ departs from a straight line over the span of
    temperatures only says how to solve the balance. For a surface at T about a mean M, the excess over the line is
    (T - M)² · 3 / (2 M) to second order, in kelvin.
    """
    obs = inspected.obs
    found = judged(inspected.weathered, "radiation", obs.why or NO_BALANCE)
    if obs.tracks is None:
        return found
    span_k = _span(torch.where(obs.tracks.weights > 0, obs.tracks.values, torch.nan)) * obs.unit_k
    bent = 1.5 * (0.5 * span_k) ** 2 / MEAN_K > 3.0 * obs.noise * obs.unit_k
    # A balance that is solved about its mean alone has bodies with a core.
    nodes = 1 if bent or inspected.weathered is None else inspected.weathered.nodes
    return replace(found, settings={"solution": "corrected" if bent else "linear", "nodes": nodes})


def _span(values: Tensor) -> float:
    """Range over time [P, F] (nan where not seen) that a tenth of the points exceed."""
    low = torch.nan_to_num(values, nan=torch.inf).amin(1)
    high = torch.nan_to_num(values, nan=-torch.inf).amax(1)
    return float((high - low)[(high > low)].quantile(0.9)) if bool((high > low).any()) else 0.0


EFFECT = Effect(
    name="radiation",
    stage="state",
    place=3,
    summary="long waves to and from the sky, as the sky sends them",
    source="ThermoGS, Eq. 5",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="temperatures follow air and sun, not the sky",
    threshold=SIGMAS,
    adds="an emissivity for each Gaussian, one driver",
    evidence=evidence,
    part=Part("state", "energy_balance", off={"sky": None}),
    stands_on="relaxation",
    displaces=weather_record.INSTEAD,
)
