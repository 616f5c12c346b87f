"""What torch computes with other bits on another number of threads, here with the same on any.

torch splits a tensor of 32,768 numbers or more among its threads. A sum to one number then adds in another order, and a sigmoid
or a softplus leaves what ends between two vectors at other places, where it is computed in another way. The last bits of a run,
and in the end its Gaussians, would differ from one machine to another. Sums along a row do not, nor do products of two matrices
(``heatsplat/__init__.py`` asks MKL for that); those of a matrix and a vector do.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from heatsplat.derivatives import once_differentiable

PIECE = 32768  # numbers that torch leaves to one thread
ROW = 4096  # numbers, less than a piece


def total(values: Tensor) -> Tensor:
    """The sum of all values, []; the same bits for any number of threads, of up to 2^27 values."""
    flat = values.reshape(-1)
    whole = len(flat) // ROW * ROW
    return flat[:whole].view(-1, ROW).sum(1).sum() + flat[whole:].sum()


def mean(values: Tensor) -> Tensor:
    """The mean of all values, []; NaN of none."""
    return total(values) / values.numel()


def everywhere(value: Tensor, like: Tensor) -> Tensor:
    """A number, [] or of one element, in every place of a tensor [...]; its gradient is a ``total``."""
    return _Everywhere.apply(value, like.shape)


def sigmoid(values: Tensor) -> Tensor:
    """The sigmoid of values of any shape; on a CPU one piece after the other."""
    return values.sigmoid() if values.numel() <= PIECE or values.device.type != "cpu" else _Sigmoid.apply(values)


def softplus(values: Tensor) -> Tensor:
    """log(1 + e^x) of values of any shape; of many on a CPU by functions that do not depend on the threads."""
    few = values.numel() <= PIECE or values.device.type != "cpu"
    return torch.nn.functional.softplus(values) if few else _Softplus.apply(values)


def weighted(columns: Tensor, weights: Tensor) -> Tensor:
    """The columns of a tensor [n, K] weighted with K numbers and added, [n]; the gradients of both have the same bits, too."""
    return (columns @ weights[:, None])[:, 0]


def to_one(values: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    """A linear layer that gives one number, of values [..., K] with weights [1, K] and a bias [1]; [..., 1].

    The gradient of the bias is a ``total``.
    """
    rows = values.flatten(0, -2)
    return torch.addmm(everywhere(bias, rows[:, :1]), rows, weight.T).view(*values.shape[:-1], 1)


class _Everywhere(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor, shape: torch.Size) -> Tensor:
        ctx.own = value.shape
        return value.expand(shape)

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return total(grad).view(ctx.own), None


class _Sigmoid(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        found = torch.empty_like(values, memory_format=torch.contiguous_format)
        pieces = zip(values.reshape(-1).split(PIECE), found.view(-1).split(PIECE), strict=True)
        for piece, place in pieces:
            torch.sigmoid(piece, out=place)
        ctx.save_for_backward(found)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        (found,) = ctx.saved_tensors
        return torch.ops.aten.sigmoid_backward(grad, found)


class _Softplus(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor) -> Tensor:
        ctx.save_for_backward(values)
        return values.clamp(min=0.0) + torch.log1p(torch.exp(-values.abs()))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> Tensor:
        return grad * sigmoid(ctx.saved_tensors[0])
