"""One Gaussian in the place of two: its moments, its opacity, and how far it is from them. Pure functions in float64."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from heatsplat.geometry.rotations import matrices_to_quats, quats_to_matrices
from heatsplat.splats import Splats

MAX_OPACITY = 0.999  # of a merged Gaussian; renderers show no more


@dataclass(frozen=True)
class Shapes:
    """n Gaussians: means [n, 3], axes [n, 3, 3] and opacities [n, M], float64.

    Axes stand in columns, perpendicular to each other and as long as the standard deviation along them. Covariances, of which
    they are a root, hold their squares: of a needle, all digits of its width would be lost beside its length.
    """

    means: Tensor
    axes: Tensor
    opacities: Tensor

    @classmethod
    def of(cls, splats: Splats) -> Shapes:
        """Those of splats, as they are stored. One with a zero quaternion, which renderers do not show, has no size."""
        quats = splats.quats.detach().double()
        sizes = splats.scales.detach().double() * quats.any(dim=1, keepdim=True)
        axes = quats_to_matrices(quats) * sizes[:, None]
        return cls(splats.means.detach().double(), axes, splats.opacities.detach().double().T)

    def __getitem__(self, ids: Tensor) -> Shapes:
        return Shapes(self.means[ids], self.axes[ids], self.opacities[ids])

    @property
    def masses(self) -> Tensor:
        """Mean opacity times visible size [n]: the root of the mean squared area over all directions of view, up to a factor.

        The volume of a flat Gaussian says nothing of how much of an image it covers, and may be zero.
        """
        a, b, c = self.axes.square().sum(1).unbind(1)
        return self.opacities.mean(1) * (a * b + b * c + c * a).sqrt()


@dataclass(frozen=True)
class Merged:
    """One Gaussian for each of n pairs.

    Args:
        shapes: the merged Gaussians.
        axes: [n, 3, 3] their principal axes, in columns.
        variances: [n, 3] along them.
        shares: [n] weight of the first of the pair in every mean, in [0, 1].
        distances: [n] squared difference of the two alphas and the merged one, integrated over the plane, by that of the two
            alphas squared; mean over three directions of view. 0 where nothing changes, inf where one of the pair has no size.
    """

    shapes: Shapes
    axes: Tensor
    variances: Tensor
    shares: Tensor
    distances: Tensor

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
    spread = [  # columns, whose products with themselves add up to the covariance
        share.sqrt()[..., None] * torch.cat([one.axes, (one.means - means)[..., None]], dim=2)
        for share, one in ((near, first), (far, second))
    ]
    axes, deviations, _ = torch.linalg.svd(torch.cat(spread, dim=2), full_matrices=False)
    variances = deviations.square().clamp(min=torch.finfo(torch.float32).tiny)
    shape = axes * variances.sqrt()[:, None]

    turned = [axes.mT @ one.axes for one in (first, second)]
    turned.append(torch.diag_embed(variances.sqrt()))
    places = [(axes.mT @ (one - means)[..., None]).squeeze(-1) for one in (first.means, second.means, means)]
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    own = [_mixed(one, one) / 2 for one in turned]
    products = {(i, j): _products(turned[i], turned[j], own[i], own[j], places[i] - places[j]) for i, j in pairs}
    areas = [2 * math.pi * determinants.sqrt() for determinants in own]  # ∫ exp(-x² / 2) over the plane

    o1, o2 = first.opacities, second.opacities
    covered = o1 * _total(areas[0]) + o2 * _total(areas[1]) - o1 * o2 * _total(products[0, 1])
    opacities = (covered / _total(areas[2])).clamp(max=MAX_OPACITY)
    a, b, c = (one.mean(1, keepdim=True) for one in (o1, o2, opacities))
    squares = a * a * products[0, 0] + b * b * products[1, 1] + 2 * a * b * products[0, 1]
    change = squares + c * c * products[2, 2] - 2 * a * c * products[0, 2] - 2 * b * c * products[1, 2]
    distances = (change.sum(1) / squares.sum(1)).clamp(min=0).nan_to_num(torch.inf)
    shown = first.axes.any(2).any(1) & second.axes.any(2).any(1)
    distances = torch.where(shown, distances, torch.inf)
    return Merged(Shapes(means, shape, opacities), axes, variances, shares, distances)


def _total(seen: Tensor) -> Tensor:
    """Sum [n, 1] over the three views of [n, 3]."""
    return seen.sum(1, keepdim=True)


def _mixed(one: Tensor, other: Tensor) -> Tensor:
    """Of two sets of axes [n, 3, 3], what the determinant of the sum of their 2 x 2 covariances, seen along each axis, has beside
    those of either, [n, 3]: a sum of squares, of which nothing cancels (Cauchy and Binet). Of a set with itself twice its own."""
    return torch.linalg.cross(one[:, :, :, None], other[:, :, None], dim=1).square().sum((2, 3))


def _products(one: Tensor, other: Tensor, own: Tensor, others: Tensor, offset: Tensor) -> Tensor:
    """∫ of the product of two Gaussians of peak 1 over the plane, seen along each axis, [n, 3]; with their determinants."""
    both = (own + others + _mixed(one, other)).clamp(min=torch.finfo(torch.float64).tiny)
    squares = torch.linalg.cross(torch.cat([one, other], dim=2), offset[..., None], dim=1).square().sum(2)
    return 2 * math.pi * (own * others / both).sqrt() * torch.exp(-squares / both / 2)
