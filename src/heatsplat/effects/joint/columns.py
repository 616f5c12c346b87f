"""Columns of the joint fit, of which an observation has few entries that are not zero."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Columns:
    """Columns [P, F, c] over the observations of P points in F images.

    Args:
        slots: [P, F, m] int64 which ones have an entry there; one may come twice, and counts as the sum.
        values: [P, F, m] the entries.
        count: c, how many there are.
    """

    slots: Tensor
    values: Tensor
    count: int

    @classmethod
    def dense(cls, values: Tensor) -> Columns:
        """Those that may differ from zero everywhere, values [P, F, c]."""
        count = values.shape[2]
        return cls(torch.arange(count).expand(values.shape), values, count)

    @classmethod
    def of_images(cls, values: Tensor) -> Columns:
        """One for each image, which is zero in the others, from values [P, F]."""
        frames = values.shape[1]
        return cls(torch.arange(frames)[:, None].expand(*values.shape, 1), values[..., None], frames)

    @classmethod
    def joined(cls, parts: Sequence[Columns]) -> Columns:
        """All columns of several parts, in their order."""
        ends = torch.tensor([part.count for part in parts]).cumsum(0).tolist()
        slots = [part.slots + (end - part.count) for part, end in zip(parts, ends, strict=True)]
        return cls(torch.cat(slots, 2), torch.cat([part.values for part in parts], 2), ends[-1])

    def __mul__(self, factor: Tensor | float) -> Columns:
        """The columns times a number, or times one [P, F, 1] for each observation."""
        return Columns(self.slots, self.values * factor, self.count)

    def __matmul__(self, numbers: Tensor) -> Tensor:
        """What numbers [c] make of them, [P, F]."""
        return (self.values * numbers[self.slots]).sum(2)
