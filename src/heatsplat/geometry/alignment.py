"""How well two sets of cameras agree, whatever world each is in."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from heatsplat.geometry.projection import eyes


class Similarity(NamedTuple):
    """x -> scale * rotation @ x + shift."""

    scale: Tensor
    rotation: Tensor
    shift: Tensor

    def __call__(self, points: Tensor) -> Tensor:
        """Points [n, 3] in the other world."""
        return self.scale * points @ self.rotation.T + self.shift


class PoseErrors(NamedTuple):
    """Errors of cameras after the similarity that fits them best.

    Args:
        degrees: [n] angle between the orientations.
        percent: [n] distance between the centres, in per cent of the size of the scene: the largest distance of a true
            centre from their mean.
        similarity: from the found world to the true one.
    """

    degrees: Tensor
    percent: Tensor
    similarity: Similarity


def similarity_between(source: Tensor, target: Tensor) -> Similarity:
    """The similarity that brings points [n, 3] closest to others [n, 3], by least squares (Umeyama 1991, Eq. 40 to 42).

    Raises:
        ValueError: fewer than three points, or all at one place.
    """
    if len(source) < 3:
        raise ValueError(f"a similarity needs three points or more, got {len(source)}")
    middle, to = source.mean(0), target.mean(0)
    spread = (source - middle).square().sum(1).mean()
    if not spread > 0:
        raise ValueError("all points lie at one place")
    u, singular, vt = torch.linalg.svd((target - to).T @ (source - middle) / len(source))
    sign = torch.ones_like(singular)
    sign[-1] = torch.sign(torch.linalg.det(u) * torch.linalg.det(vt))
    rotation = u @ torch.diag(sign) @ vt
    scale = (singular * sign).sum() / spread
    return Similarity(scale, rotation, to - scale * rotation @ middle)


def pose_errors(found: Tensor, true: Tensor) -> PoseErrors:
    """Errors of world-to-camera matrices [n, 4, 4] against true ones, float64.

    **Convention:** scale and shift come from the centres, as does the rotation unless the centres lie on a line, where the
    orientations give it.
    """
    centres, true_centres = eyes(found), eyes(true)
    size = (true_centres - true_centres.mean(0)).norm(dim=1).max()
    fitted = similarity_between(centres, true_centres)
    flatness = torch.linalg.svdvals(true_centres - true_centres.mean(0))
    if flatness[1] < 0.02 * flatness[0]:
        u, _, vt = torch.linalg.svd((true[:, :3, :3].mT @ found[:, :3, :3]).mean(0))
        rotation = u @ torch.diag(torch.tensor([1.0, 1.0, float(torch.det(u @ vt))], dtype=u.dtype)) @ vt
        away, true_away = (c - c.mean(0) for c in (centres, true_centres))
        scale = ((away @ rotation.T) * true_away).sum() / away.square().sum()
        fitted = Similarity(scale, rotation, true_centres.mean(0) - scale * rotation @ centres.mean(0))
    apart = true[:, :3, :3] @ fitted.rotation @ found[:, :3, :3].mT
    cosine = 0.5 * (apart.diagonal(dim1=1, dim2=2).sum(1) - 1.0)
    sine = 0.5 * (apart - apart.mT).flatten(1).norm(dim=1) / 2.0**0.5
    return PoseErrors(
        torch.rad2deg(torch.atan2(sine, cosine)), 100.0 * (fitted(centres) - true_centres).norm(dim=1) / size, fitted
    )
