"""Sums over the pixels of an image in one order, whatever the number of threads.

torch splits a sum to one number among its threads, so its last bits depend on how many there are, and with them a whole run:
its Gaussians differ from one machine to another. Sums along a row do not.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

ROW = 4096  # numbers; torch leaves sums of fewer than 32768 to one thread


def total(values: Tensor) -> Tensor:
    """The sum of all values, []; the same bits for any number of threads, of up to 2^27 values."""
    flat = values.reshape(-1)
    whole = len(flat) // ROW * ROW
    return flat[:whole].view(-1, ROW).sum(1).sum() + flat[whole:].sum()


def everywhere(value: Tensor, image: Tensor) -> Tensor:
    """A number [] in every place of an image [...]; its gradient is a ``total``."""
    return _Everywhere.apply(value, image.shape)


class _Everywhere(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor, shape: torch.Size) -> Tensor:
        return value.expand(shape)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return total(grad), None
