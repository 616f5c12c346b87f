"""Which frequencies a heat source may have, given when a scene was seen and how fast its bodies can follow."""

from __future__ import annotations

import logging
import math

import torch
from torch import Tensor

log = logging.getLogger(__name__)

LOWEST_HZ = 1e-5  # ETGS Eq. 27
SAME_MOMENT_S = 1e-6  # timestamps closer than this are one moment: clocks since 1970 in float64 resolve 2e-7 s
NARROWEST_BAND = 1.2  # the highest frequency is at least this times the lowest (ETGS Eq. 34)
SEPARATION = 0.5  # cycles over the record by which frequencies differ at least (the authors' code; the text: no number)


def default_tau_min(timestamps: Tensor) -> float:
    """The shortest time constant in seconds that timestamps [F] can show: their median gap, at least span / 200.

    The paper leaves it open. 0 when fewer than two of the timestamps differ.
    """
    gaps = _positive_gaps(timestamps)
    return max(gaps.median().item(), gaps.sum().item() / 200) if gaps.numel() else 0.0


def frequency_grid(
    timestamps: Tensor, count: int, tau_min: float, gain: float, separation: float = SEPARATION
) -> Tensor:
    """Angular frequencies [K'] in rad/s, float64, ascending, K' <= count (ETGS Eq. 7 and 27-34).

    Log-uniform from one cycle over the observed span, or ``LOWEST_HZ`` where that is more, up to what the sampling resolves
    (half the inverse of the smallest gap) and what a body with time constant ``tau_min`` still follows with amplitude
    ``gain``; at least 1.2 times the lowest frequency. Of these, from the lowest up, those stay that complete ``separation``
    cycles more over the span than the last one that stayed: a record of that length cannot tell closer ones apart.

    **Degenerate cases:** repeated timestamps count once; count = 1 gives the lowest frequency alone; fewer than two
    distinct timestamps (or count = 0) give an empty grid, so that a model falls back to pure relaxation, with a
    warning; equal frequencies are removed; gain = 1 allows no frequency above the lowest, which leaves the band of 1.2;
    where the sampling resolves less than ``LOWEST_HZ``, that band lies above it, with a warning.

    Args:
        timestamps: [F] seconds, in any order.
        count: how many frequencies to ask for, at least 0.
        tau_min: shortest time constant in seconds, above 0 (see ``default_tau_min``).
        gain: steady-state amplitude in (0, 1] below which a frequency is not worth having; α of the paper.
        separation: cycles over the span by which neighbours differ at least; 0 removes equal ones alone (App. B).

    Raises:
        ValueError: a timestamp is not finite, or count, tau_min, gain or separation lies outside its range.
    """
    if count != int(count) or count < 0:
        raise ValueError(f"count of frequencies must be a whole number of at least 0, got {count}")
    if not 0 < gain <= 1:
        raise ValueError(f"frequency_gain must lie in (0, 1], got {gain}; 0.7071 is the half-power point")
    if not 0 <= separation < math.inf:
        raise ValueError(f"separation must be a number of cycles of at least 0, got {separation}")
    gaps = _positive_gaps(timestamps)
    if count == 0:
        return torch.zeros(0, dtype=torch.float64)
    if gaps.numel() == 0:
        log.warning(
            "no two timestamps differ (%d given): no frequency can be told apart, so the heat source is left out",
            timestamps.numel(),
        )
        return torch.zeros(0, dtype=torch.float64)
    if not (math.isfinite(tau_min) and tau_min > 0):
        raise ValueError(f"tau_min must be a number of seconds above 0, got {tau_min}")
    span = gaps.sum().item()
    lowest = max(1 / span, LOWEST_HZ)
    sampled = 0.5 / gaps.min().item()
    if sampled < LOWEST_HZ:
        log.warning(
            "images at least %.3g h apart cannot tell frequencies of %g Hz and more, so that what a heat source does between "
            "them is arbitrary: thermal.frequencies=0 leaves relaxation alone",
            gaps.min().item() / 3600.0,
            LOWEST_HZ,
        )
    followed = math.sqrt((1 - gain) * (1 + gain)) / gain / (2 * math.pi * tau_min)
    highest = max(min(sampled, followed), NARROWEST_BAND * lowest)
    steps = torch.arange(int(count), dtype=torch.float64) / max(count - 1, 1)
    hertz = lowest * (highest / lowest) ** steps
    return 2 * math.pi * _apart(hertz.unique(), separation / span)


def _apart(values: Tensor, least: float) -> Tensor:
    """Of ascending values the first, and each that lies at least so far above the last one that stayed."""
    kept: list[float] = []
    for value in values.tolist():
        if not kept or value - kept[-1] >= least:
            kept.append(value)
    return torch.tensor(kept, dtype=torch.float64)


def _positive_gaps(timestamps: Tensor) -> Tensor:
    times = timestamps.detach().to("cpu", torch.float64).flatten()
    if not times.isfinite().all():
        raise ValueError("timestamps must be finite numbers of seconds; a frame without a time cannot be used here")
    gaps = times.sort().values.diff()
    return gaps[gaps > SAME_MOMENT_S]
