"""Weighted least squares for numbers of which most belong to one point each: those are eliminated point by point."""

from __future__ import annotations

import torch
from torch import Tensor

RIDGE = 1e-9
_AT_ONCE = 2_000_000  # numbers that are held at once


def own_weights(basis: Tensor, values: Tensor, weights: Tensor) -> Tensor:
    """Weights [P, k] of the points' own bases [P, F, k] that fit values [P, F] best; ``weights`` [P, F]."""
    root = weights.sqrt()[..., None]
    own = root * basis
    scale = own.norm(dim=1, keepdim=True).clamp_min(1e-150)
    own = own / scale
    inner = own.mT @ own + RIDGE * torch.eye(own.shape[2], dtype=own.dtype)
    return (torch.linalg.solve(inner, own.mT @ (root * values[..., None])) / scale.mT)[..., 0]


def own_part(basis: Tensor, values: Tensor, weights: Tensor) -> Tensor:
    """What the points' own bases [P, F, k] make of values [P, F]."""
    return (basis @ own_weights(basis, values, weights)[..., None])[..., 0]


def gram(basis: Tensor, columns: Tensor, weights: Tensor) -> Tensor:
    """Inner products [c, c] of columns [P, F, c] with what the points' own bases [P, F, k] can say taken away."""
    result = columns.new_zeros(columns.shape[2], columns.shape[2])
    step = max(1, _AT_ONCE // (columns.shape[1] * (columns.shape[2] + basis.shape[2])))
    for first in range(0, len(columns), step):
        part = slice(first, first + step)
        root = weights[part].sqrt()[..., None]
        own, wanted = root * basis[part], root * columns[part]
        own = own / own.norm(dim=1, keepdim=True).clamp_min(1e-300)
        inner = own.mT @ own + RIDGE * torch.eye(own.shape[2], dtype=own.dtype)
        rest = (wanted - own @ torch.linalg.solve(inner, own.mT @ wanted)).flatten(0, 1)
        result += rest.T @ rest
    return result


def scaled(products: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normal equations from inner products [1 + c, 1 + c] of values and columns, in units in which each column has length 1:
    matrix [c, c], right side [c], and the units [c] that take numbers back."""
    scale = products.diagonal()[1:].clamp_min(1e-150).rsqrt()
    return scale[:, None] * products[1:, 1:] * scale, scale * products[1:, 0], scale


def shared_weights(products: Tensor) -> Tensor:
    """Weights [c] of columns that fit values best, from their inner products (``gram``), the values first."""
    inner, right, scale = scaled(products)
    return scale * torch.linalg.solve(inner + RIDGE * torch.eye(len(scale), dtype=inner.dtype), right)
