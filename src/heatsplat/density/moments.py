"""One Gaussian in the place of two: its moments, its opacity, and how far it is from them. Pure functions in float64."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from heatsplat.geometry.rotations import matrices_to_quats, quats_to_matrices
from heatsplat.splats import Splats

MAX_OPACITY = 0.999  # of a merged Gaussian; renderers show no more
KEPT = ((1, 2), (0, 2), (0, 1))  # axes that are left of a shape seen along each axis


@dataclass(frozen=True)
class Shapes:
    """n Gaussians: means [n, 3], covariances [n, 3, 3] and opacities [n, M], float64."""

    means: Tensor
    covariances: Tensor
    opacities: Tensor

    @classmethod
    def of(cls, splats: Splats) -> Shapes:
        """Those of splats, as they are stored."""
        axes = quats_to_matrices(splats.quats.detach().double()) * splats.scales.detach().double()[:, None]
        return cls(splats.means.detach().double(), axes @ axes.mT, splats.opacities.detach().double().T)

    def __getitem__(self, ids: Tensor) -> Shapes:
        return Shapes(self.means[ids], self.covariances[ids], self.opacities[ids])

    @property
    def masses(self) -> Tensor:
        """Mean opacity times visible size [n]: the root of the mean squared area over all directions of view, up to a factor.

        The volume of a flat Gaussian says nothing of how much of an image it covers, and may be zero.
        """
        first = self.covariances.diagonal(dim1=1, dim2=2).sum(1).square()
        minors = (first - self.covariances.square().sum((1, 2))) / 2  # trace of the adjugate
        return self.opacities.mean(1) * minors.clamp(min=0).sqrt()


@dataclass(frozen=True)
class Merged:
    """One Gaussian for each of n pairs.

    Args:
        shapes: the merged Gaussians.
        axes: [n, 3, 3] their principal axes, in columns.
        variances: [n, 3] along them.
        shares: [n] weight of the first of the pair in every mean, in [0, 1].
        distances: [n] squared difference of the two alphas and the merged one, integrated over the plane, by that of the two
            alphas squared; mean over three directions of view. 0 where nothing changes.
    """

    shapes: Shapes
    axes: Tensor
    variances: Tensor
    shares: Tensor
    distances: Tensor

    def __getitem__(self, ids: Tensor) -> Merged:
        return Merged(self.shapes[ids], self.axes[ids], self.variances[ids], self.shares[ids], self.distances[ids])

    def raw(self) -> dict[str, Tensor]:
        """The geometry as ``Splats`` stores it: means, log_scales, quats and opacity_logits."""
        flip = torch.ones_like(self.variances)
        flip[:, 2] = torch.linalg.det(self.axes).sign()
        return {
            "means": self.shapes.means,
            "log_scales": self.variances.log() / 2,
            "quats": matrices_to_quats(self.axes * flip[:, None]),
            "opacity_logits": torch.logit(self.shapes.opacities),
        }


def merged(first: Shapes, second: Shapes) -> Merged:
    """The Gaussians with the moments of pairs, weighted by mass, and with as much alpha as a camera sees of the two.

    What a camera sees of two Gaussians on top of each other is a + b - ab. Its integral over the plane has a closed form, as
    does that of one; the opacity is the ratio of both, each summed over views along the three principal axes of the merged
    Gaussian (parallel light, no blur).
    """
    masses = torch.stack([first.masses, second.masses])
    shares = (masses[0] / masses.sum(0)).nan_to_num(0.5)
    near, far = shares[:, None], 1 - shares[:, None]
    means = near * first.means + far * second.means
    covariances = torch.zeros_like(first.covariances)
    for share, one in ((near, first), (far, second)):
        off = one.means - means
        covariances += share[..., None] * (one.covariances + off[:, :, None] * off[:, None])
    variances, axes = torch.linalg.eigh(covariances)
    variances = variances.clamp(min=torch.finfo(torch.float32).tiny)

    turned = [axes.mT @ one.covariances @ axes for one in (first, second)]
    turned.append(torch.diag_embed(variances))
    places = [(axes.mT @ (one - means)[..., None]).squeeze(-1) for one in (first.means, second.means, means)]
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    products = {pair: _products(*(turned[i] for i in pair), places[pair[0]] - places[pair[1]]) for pair in pairs}
    areas = [_areas(turned[i]) for i in range(3)]

    o1, o2 = first.opacities, second.opacities
    covered = o1 * _total(areas[0]) + o2 * _total(areas[1]) - o1 * o2 * _total(products[0, 1])
    opacities = (covered / _total(areas[2])).clamp(max=MAX_OPACITY)
    a, b, c = (one.mean(1, keepdim=True) for one in (o1, o2, opacities))
    squares = a * a * products[0, 0] + b * b * products[1, 1] + 2 * a * b * products[0, 1]
    change = squares + c * c * products[2, 2] - 2 * a * c * products[0, 2] - 2 * b * c * products[1, 2]
    distances = (change.sum(1) / squares.sum(1)).clamp(min=0).nan_to_num(torch.inf)
    return Merged(Shapes(means, covariances, opacities), axes, variances, shares, distances)


def _total(seen: Tensor) -> Tensor:
    """Sum [n, 1] over the three views of [n, 3]."""
    return seen.sum(1, keepdim=True)


def _determinants(covariances: Tensor) -> Tensor:
    """Those of 2 x 2 covariances seen along each axis, [n, 3]."""
    found = [covariances[:, i, i] * covariances[:, j, j] - covariances[:, i, j] * covariances[:, j, i] for i, j in KEPT]
    return torch.stack(found, dim=1).clamp(min=0)


def _areas(covariances: Tensor) -> Tensor:
    """∫ exp(-x² / 2) over the plane, seen along each axis, [n, 3]."""
    return 2 * math.pi * _determinants(covariances).sqrt()


def _products(one: Tensor, other: Tensor, offset: Tensor) -> Tensor:
    """∫ of the product of two Gaussians of peak 1 over the plane, seen along each axis, [n, 3]."""
    both = one + other
    found = []
    for i, j in KEPT:
        x, y = offset[:, i], offset[:, j]
        squares = both[:, j, j] * x * x - 2 * both[:, i, j] * x * y + both[:, i, i] * y * y
        found.append(squares)
    determinants = _determinants(both)
    tiny = torch.finfo(torch.float64).tiny
    exponents = torch.stack(found, dim=1) / determinants.clamp(min=tiny)
    sizes = (_determinants(one) * _determinants(other) / determinants.clamp(min=tiny)).sqrt()
    return 2 * math.pi * sizes * torch.exp(-exponents / 2)
