"""A camera that is swung while its detector lags and its rows are read one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

_SETTLED = 12.0  # time constants that the detector has looked before the first row is read
_STEPS = 8  # exposures in a time constant


@dataclass(frozen=True)
class Bolometers:
    """Pixels that are warmed by what they see: τ dy/dt = x - y, read row by row.

    Args:
        tau_s: τ; 0 for pixels that follow at once.
        readout_s: what all rows take together, each as long as any.
    """

    tau_s: float = 0.0
    readout_s: float = 0.0

    def images(self, seen: Callable[[Sequence[float]], Iterator[Tensor]], times_s: np.ndarray, rows: int) -> Tensor:
        """What is read about these moments, [F, rows, W] float64; the middle of the image at the moment itself.

        The answer is exact for what is linear in time between exposures, an eighth of τ apart (of the read-out where τ is 0).

        Args:
            seen: clean images [rows, W] at moments, in their order.
            times_s: [F] increasing.
        """
        offsets = ((np.arange(rows) + 0.5) / rows - 0.5) * self.readout_s
        step = (self.tau_s or self.readout_s) / _STEPS
        start = times_s[0] + offsets[0] - _SETTLED * self.tau_s
        moments = start + step * np.arange(math.ceil((times_s[-1] + offsets[-1] - start) / step) + 2)
        due = times_s[:, None] + offsets  # [F, rows]
        read, state, before = None, None, None
        for now, image in zip(moments, seen(moments.tolist()), strict=True):
            if read is None:
                read = torch.empty(len(times_s), *image.shape, dtype=torch.float64)
                state, before, last = image, image, now
                continue
            frames, lines = np.nonzero((due >= last) & (due < now))
            if len(frames):
                share = torch.from_numpy((due[frames, lines] - last) / (now - last))[:, None]
                passed = torch.from_numpy(due[frames, lines] - last)[:, None]
                reached = torch.lerp(before[lines], image[lines], share)
                read[frames, lines] = self._answer(state[lines], before[lines], reached, passed)
            state = self._answer(state, before, image, torch.tensor(now - last, dtype=torch.float64))
            before, last = image, now
        return read

    def _answer(self, state: Tensor, before: Tensor, after: Tensor, passed: Tensor) -> Tensor:
        """y after a time in which x went from ``before`` to ``after`` along a line, of y = ``state`` at its start."""
        if not self.tau_s:
            return after
        steady = (after - before) * (self.tau_s / passed.clamp_min(1e-12))  # how far y trails behind a line
        return after - steady + torch.exp(-passed / self.tau_s) * (state - before + steady)
