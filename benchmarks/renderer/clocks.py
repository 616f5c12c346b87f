"""Times of what is compared, taken in turns."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from heatsplat.kernels.scheduling import use_threads


def set_threads(count: int) -> None:
    """Threads of the kernels and of torch."""
    use_threads(count)
    torch.set_num_threads(count)


def interleaved(runs: dict[str, Callable[[], Sequence[float]]], rounds: int) -> dict[str, np.ndarray]:
    """Milliseconds [rounds, ...] of each run, taken in turns; a first round, which compiles, does not count."""
    times: dict[str, list] = {name: [] for name in runs}
    for _ in range(rounds + 1):
        for name, timed in runs.items():
            times[name].append(timed())
    return {name: 1e3 * np.array(values[1:]) for name, values in times.items()}
