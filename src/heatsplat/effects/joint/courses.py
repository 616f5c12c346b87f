"""Courses over time that points have in common, each in its own measure: decays, and whatever else changes a scene."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

from heatsplat.effects.joint.least_squares import RIDGE, own_part, own_weights
from heatsplat.effects.joint.model import Model

if TYPE_CHECKING:
    from heatsplat.effects.joint.fit import Fit

ANY = "any change"  # in a model: courses of anything beside the points' levels
SWEEPS = 4  # of alternating least squares
# Mixtures of these decays, as rates times the record's length, stand for any course that relaxes: the surface of a deep
# body does not follow one exponential. Within 0.5 % of the excess for slabs of Biot number 0 to 3.
DECAYS = (0.6, 2.5, 9.0, 40.0)
LONG = 24  # observations of a point from which all of these can be told apart; below that, DECAYS_FEW
DECAYS_FEW = (0.7, 3.0, 12.0)


def common_courses(fit: Fit, beside: Model, count: int) -> Tensor:
    """Courses [F, count] by which points depart from what their own part of a model explains.

    The leading directions of what that leaves, by alternating least squares.
    """
    values = fit.data.tracks.values - sum(fit.known.values())
    own_basis = fit.own_basis(beside)
    left = (values - own_part(own_basis, values, fit.weights)) * (fit.weights > 0)
    weights = fit.weights / fit.trust[:, None]
    scale = weights.sum(1).clamp_min(1e-300)[:, None]
    _, found = torch.linalg.eigh((left * weights / scale).T @ left)
    found = found[:, -count:]
    for _ in range(SWEEPS):
        basis = torch.cat([own_basis, found.expand(len(values), -1, -1)], 2)
        own = own_weights(basis, values, fit.weights)
        amplitudes, rest = own[:, -count:], values - (own_basis @ own[:, :-count, None])[..., 0]
        inner = torch.einsum("pf,pi,pj->fij", weights, amplitudes, amplitudes)
        inner = inner + RIDGE * inner.diagonal(dim1=1, dim2=2).mean().clamp_min(1e-150) * torch.eye(
            count, dtype=values.dtype
        )
        found = torch.linalg.solve(inner, torch.einsum("pf,pi,pf->fi", weights, amplitudes, rest))
        found = torch.linalg.qr(found).Q
    return found
