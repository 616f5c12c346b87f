"""Weighted least squares for numbers of which most belong to one point each: those are eliminated point by point."""

from __future__ import annotations

import torch
from torch import Tensor

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


def gram(basis: Tensor, columns: Tensor, weights: Tensor) -> Tensor:
    """Inner products [c, c] of columns [P, F, c] with what the points' own bases [P, F, k] can say taken away.

    A column of which they say all but the rounding is 0 then. Columns that are there in one image alone, as offsets and gains of
    single images are, cost as many operations as if there were one image.
    """
    images = (columns != 0).any(0)
    single = images.sum(0) == 1
    at, only, others = images[:, single].to(torch.uint8).argmax(0), single.nonzero()[:, 0], (~single).nonzero()[:, 0]
    within, taken = (columns.new_zeros(columns.shape[2], columns.shape[2]) for _ in range(2))
    same = at[:, None] == at
    step = max(1, _AT_ONCE // (columns.shape[1] * (len(others) + basis.shape[2]) + len(only)))
    for first in range(0, len(columns), step):
        part = slice(first, first + step)
        root = weights[part].sqrt()[..., None]
        own, wanted = root * basis[part], root * (columns[part][..., others] if len(only) else columns[part])
        own = own / own.norm(dim=1, keepdim=True).clamp_min(1e-300)
        there = root[:, at, 0] * columns[part][:, at, only]  # [p, single ones]
        within[only[:, None], only] += same * (there.T @ there)
        within[only[:, None], others] += torch.einsum("ps,pso->so", there, wanted[:, at])
        within[others[:, None], others] += wanted.flatten(0, 1).T @ wanted.flatten(0, 1)
        said = columns.new_empty(len(root), own.shape[2], columns.shape[2])
        said[..., only] = own[:, at].mT * there[:, None]
        said[..., others] = own.mT @ wanted
        inner = own.mT @ own + RIDGE * torch.eye(own.shape[2], dtype=own.dtype)
        found = torch.linalg.solve(inner, said).flatten(0, 1)
        said = said.flatten(0, 1)
        # What is left has the products W'W - B'S - r S'S, for (O'O + r) S = B = O'W.
        taken += (said + RIDGE * found).T @ found
    within[others[:, None], only] = within[only[:, None], others].T
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
