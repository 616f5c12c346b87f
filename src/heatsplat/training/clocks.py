"""The clocks by which training time is told."""

from __future__ import annotations

import time

CLOCKS = ("train_seconds", "cpu_seconds")  # costs of a run that are time of its training (callbacks.timing.CostMeter)


def read_clock(name: str) -> float:
    """Seconds, since some moment, of the clock behind a cost of ``CLOCKS``.

    "train_seconds" is wall time, "cpu_seconds" processor time of this process, all of its threads added up.
    """
    return time.perf_counter() if name == "train_seconds" else time.process_time()
