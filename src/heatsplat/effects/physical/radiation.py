"""Long waves to and from the sky."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.effects import weather_record
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection

BENT = 1.0  # statistic above which T⁴ shows as what it is: the bend is three times the noise
MEAN_K = 290.0


def evidence(inspected: Inspection) -> Evidence:
    """Whether T⁴ departs from a straight line over the span of temperatures by more than the noise.

    For a surface at T about a mean M: the excess over the line is (T - M)² · 3 / (2 M) to second order, in kelvin.
    """
    obs = inspected.obs
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


def _span(values: Tensor) -> float:
    """Range over time [P, F] (nan where not seen) that a tenth of the points exceed."""
    low = torch.nan_to_num(values, nan=torch.inf).amin(1)
    high = torch.nan_to_num(values, nan=-torch.inf).amax(1)
    return float((high - low)[(high > low)].quantile(0.9)) if bool((high > low).any()) else 0.0


EFFECT = Effect(
    name="radiation",
    stage="state",
    place=3,
    summary="long waves to and from the sky, beyond their linear part",
    source="ThermoGS, Eq. 5",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="over the span of temperatures T⁴ is a straight line to within the noise",
    # From 7.8 with it; no recording has weather without it.
    threshold=BENT,
    adds="an emissivity for each Gaussian, one driver",
    evidence=evidence,
    part=Part("state", "energy_balance", off={"sky": None}),
    stands_on="relaxation",
    displaces=weather_record.INSTEAD,
)
