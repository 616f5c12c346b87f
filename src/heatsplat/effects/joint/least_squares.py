"""Weighted least squares for numbers of which most belong to one point each: those are eliminated point by point."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.effects.joint.columns import Columns
from heatsplat.kernels import elimination

RIDGE = 1e-9
ROUNDING = 1e-11  # share of a column's square below which what is left of it is none
_AT_ONCE = 400_000  # numbers that are held at once, and stay in the cache


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


def gram(basis: Tensor, columns: Columns, weights: Tensor) -> Tensor:
    """Inner products [c, c] of columns with what the points' own bases [P, F, k] can say taken away; ``weights`` [P, F].

    A column of which they say all but the rounding is 0 then. Costs go with the entries that are not zero.
    """
    count, members = columns.count, basis.shape[2]
    common = basis.stride(0) == 0  # one basis that all points share
    within, taken = (basis.new_zeros(count, count) for _ in range(2))
    step = max(1, _AT_ONCE // (count * members))
    for first in range(0, len(weights), step):
        part = slice(first, first + step)
        points = len(weights[part])
        said, inner = basis.new_zeros(points, count, members), basis.new_zeros(points, members, members)
        elimination.sum_products(
            *(
                one.contiguous().numpy()
                for one in (
                    basis[:1] if common else basis[part],
                    weights[part],
                    columns.slots[part],
                    columns.values[part],
                    within,
                    said,
                    inner,
                )
            )
        )
        inner = inner + inner.tril(-1).mT + RIDGE * torch.eye(members, dtype=inner.dtype)
        said = said.mT
        found = torch.linalg.solve(inner, said).flatten(0, 1)
        said = said.flatten(0, 1)
        # What is left has the products W'W - B'S - r S'S, for (O'O + r) S = B = O'W.
        taken += (said + RIDGE * found).T @ found
    within = within + within.T
    left = within - taken
    told = left.diagonal() > ROUNDING * within.diagonal()
    return left * told * told[:, None]


def scaled(products: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Normal equations from inner products [1 + c, 1 + c] of values and columns, in units in which each column has length 1:
    matrix [c, c], right side [c], and the units [c] that take numbers back."""
    scale = products.diagonal()[1:].clamp_min(1e-150).rsqrt()
    return scale[:, None] * products[1:, 1:] * scale, scale * products[1:, 0], scale


def shared_weights(products: Tensor) -> Tensor:
    """Weights [c] of columns that fit values best, from their inner products (``gram``), the values first."""
    inner, right, scale = scaled(products)
    return scale * torch.linalg.solve(inner + RIDGE * torch.eye(len(scale), dtype=inner.dtype), right)
