"""Weights that change over a run: functions of progress, the fraction of the run that is done, from 0 to 1.

In config: ``{_target_: heatsplat.losses.schedules.linear, _partial_: true, start: 0.1, end: 0.4}``.
"""

from __future__ import annotations

import math


def linear(progress: float, start: float, end: float, before: float = 0.0, after: float = 1.0) -> float:
    """The weight of a ramp: ``before`` until ``start``, then straight to ``after`` at ``end``, constant from there.

    **Convention:** ``progress``, ``start`` and ``end`` are fractions of the run; start = end switches on at ``start``.

    Raises:
        ValueError: the ramp ends before it starts.
    """
    if end < start:
        raise ValueError(f"linear ramp ends at {end} of the run, before it starts at {start}; swap start and end")
    if progress < start:
        return before
    if progress >= end:
        return after
    return before + (after - before) * (progress - start) / (end - start)


def cosine(progress: float, start: float, end: float, before: float = 0.0, after: float = 1.0) -> float:
    """The weight of a smooth ramp: ``before`` until ``start``, ``after`` from ``end``, half a cosine between them.

    **Convention:** fractions of the run, as for ``linear``; no kink at either end (SupIR-GS, Eq. 11).

    Raises:
        ValueError: the ramp ends before it starts.
    """
    share = linear(progress, start, end)
    return before + (after - before) * 0.5 * (1.0 - math.cos(math.pi * share))
