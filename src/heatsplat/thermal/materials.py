"""A scene is made of few materials: what surfaces have in common settles what images of one of them leave open (ours)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import check_count
from heatsplat.derivatives import once_differentiable
from heatsplat.same_bits import total

ROUNDS = 5  # of Lloyd's algorithm after each division


class Materials(nn.Module):
    """A prior that holds the parameters of Gaussians about those of few materials: a mixture of normals of one spread.

    Every Gaussian belongs to the material whose parameters its own are nearest to, and pays for the distance squared. Materials
    are found once, by dividing Gaussians (``divided``), and from then on follow the means of their members, one round of
    Lloyd's algorithm a step.

    Args:
        count: materials, at least 1.
        numbers: parameters of a Gaussian at most.

    Raises:
        SceneError: the count is none, or zero.
    """

    def __init__(self, count: int, numbers: int) -> None:
        super().__init__()
        check_count("thermal.materials", count)
        self.register_buffer("means", torch.full((count, numbers), torch.nan))

    def forward(self, columns: Sequence[Tensor]) -> Tensor:
        """The mean over Gaussians of the squared distance from their materials, []; materials move to their members.

        Args:
            columns: a parameter of all Gaussians each, [N], in units in which materials differ alike; the same ones every time.
        """
        values = torch.stack([column.detach() for column in columns])
        means = self.means[:, : len(columns)]
        if means.isnan().any():
            means = divided(values, len(means))
        members = nearest(values, means)
        means = moved(values, members, means)
        self.means[:, : len(columns)] = means
        return _Distance.apply(_of_members(means, members), *columns)


def nearest(values: Tensor, means: Tensor) -> Tensor:
    """Which of the means [K, P] is nearest to values [P, N], [N].

    In float64: products round by the number of threads, which must not decide.
    """
    means = means.double()
    return torch.addmm(means.square().sum(1, keepdim=True), means, values.double(), alpha=-2).min(0).indices


def moved(values: Tensor, members: Tensor, means: Tensor) -> Tensor:
    """The means [K, P] of values [P, N] that belong together, [N]; one without members stays."""
    sums, counts = _sums(values, members, len(means))
    return torch.where(counts > 0, (sums / counts.clamp(min=1)).to(means), means)


def divided(values: Tensor, count: int) -> Tensor:
    """Means [K, P] of values [P, N], found without chance: those that scatter most along one parameter are divided there, again
    and again."""
    parameters, number = values.shape
    means = moved(values, torch.zeros(number, dtype=torch.int64, device=values.device), values.new_zeros(1, parameters))
    while len(means) < count:
        members = nearest(values, means)
        squares, counts = _sums((values - _of_members(means, members)).square(), members, len(means))
        widest, axis = divmod(int(squares.argmax()), parameters)
        step = torch.zeros_like(means[0])
        step[axis] = (squares[widest, axis] / counts[widest, 0].clamp(min=1)).sqrt()
        means = torch.cat([means, means[widest : widest + 1] + step])
        means[widest] -= step
        for _ in range(ROUNDS):
            means = moved(values, nearest(values, means), means)
    return means


def _of_members(means: Tensor, members: Tensor) -> Tensor:
    """Their means, [P, N]."""
    return means.T.contiguous().index_select(1, members)


def _sums(values: Tensor, members: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Sums [K, P] of values [P, N] that belong together, and how many they are, [K, 1]; in one order on any number of threads."""
    sums = [torch.bincount(members, row, minlength=count) for row in values.double()]
    return torch.stack(sums, 1), torch.bincount(members, minlength=count)[:, None]


class _Distance(torch.autograd.Function):
    """The mean over N of the squared distance of columns, [N] each, from points [P, N]."""

    @staticmethod
    def forward(ctx: Any, points: Tensor, *columns: Tensor) -> Tensor:
        apart = torch.stack(columns) - points
        ctx.save_for_backward(apart)
        return total(apart.square()) / points.shape[1]

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        (apart,) = ctx.saved_tensors
        return None, *(apart * (2.0 / apart.shape[1] * grad))
