"""What a ray gathers in a medium that absorbs and emits, and where along it that comes from."""

from __future__ import annotations

import torch
from torch import Tensor

BLURRED = 0.01  # share of a ray's samples that fall evenly, wherever its weights are


def weights(densities: Tensor, lengths: Tensor) -> Tensor:
    """Shares T_i (1 - e^{-σ_i δ_i}) with T_i = e^{-Σ_{j<i} σ_j δ_j} of what intervals emit in what the ray gathers (Max 1995).

    Exact where the density is constant in each interval: what is left of the light behind all is 1 - Σ of these.

    Args:
        densities: σ [R, S], one over length.
        lengths: δ [R, S].
    """
    depths = densities * lengths
    before = depths.cumsum(1) - depths
    return torch.exp(-before) * -torch.expm1(-depths)


def contracted(points: Tensor) -> Tensor:
    """All of space in [-2, 2]³: within [-1, 1]³ as it is, beyond by (2 - 1/m) x/m with m = max |x_i| (Barron et al. 2022,
    Eq. 10, with the largest norm in place of the Euclidean one). Any shape [..., 3]."""
    largest = points.abs().amax(-1, keepdim=True).clamp(min=1.0)
    return points * ((2 - 1 / largest) / largest)


def reached(shares: Tensor, near: float, span: float) -> Tensor:
    """Distances of shares s in [0, 1) of a ray: evenly from ``near`` to ``span`` over the first four fifths, then evenly in one
    over the distance, to twenty times ``span`` at 1."""
    even = near + (span - near) * shares / 0.8
    rest = ((shares - 0.8) / 0.2).clamp(0, 1)
    return torch.where(shares < 0.8, even, span / (1 - 0.95 * rest))


def drawn(edges: Tensor, found: Tensor, count: int, offsets: Tensor) -> Tensor:
    """Edges [R, count + 1] of intervals that lie densest where weights are: the inverse of their distribution function.

    Weights are spread to their neighbours first, as a surface may lie between two samples (Barron et al. 2022).

    Args:
        edges: [R, S + 1] of the intervals that the weights belong to, increasing.
        found: weights [R, S].
        count: intervals that are drawn.
        offsets: [R, 1] in [0, 1], where between two shares of the distribution a ray's samples lie.
    """
    padded = torch.cat((found[:, :1], found, found[:, -1:]), dim=1)
    either = torch.maximum(padded[:, :-1], padded[:, 1:])
    spread = 0.5 * (either[:, :-1] + either[:, 1:])
    spread = spread / spread.sum(1, keepdim=True).clamp(min=1e-6)
    spread = (1 - BLURRED) * spread + BLURRED / found.shape[1]
    steps = torch.cat((torch.zeros_like(spread[:, :1]), spread.cumsum(1)), dim=1)
    steps = steps / steps[:, -1:]
    wanted = (torch.arange(count + 1, device=found.device, dtype=found.dtype) + offsets) / (count + 1)
    after = torch.searchsorted(steps.contiguous(), wanted.contiguous(), right=True).clamp(1, found.shape[1])
    low, high = steps.gather(1, after - 1), steps.gather(1, after)
    share = ((wanted - low) / (high - low).clamp(min=1e-12)).clamp(0, 1)
    return torch.lerp(edges.gather(1, after - 1), edges.gather(1, after), share)
