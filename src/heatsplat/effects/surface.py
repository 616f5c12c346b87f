"""Which way the surface faces at the points that are followed."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import evenly_spread
from heatsplat.effects.observations import MAX_IN_FRONT, Observations
from heatsplat.geometry.surfaces import on_the_side_of, plane_axes
from heatsplat.physics.noise import MAD_TO_SIGMA

NEIGHBOURS, WIDER = 8, 16  # of a point: of its first plane, and of the one that leaves out those of other surfaces
MIN_POINTS = 12  # points below which no surface can be told
ROUNDS = 3  # of weighing neighbours by how far they are from the plane
OFF = 2.0  # usual distances from it at which a neighbour counts a quarter (Cauchy's weights, squared)


def normals(obs: Observations) -> Tensor | None:
    """Unit normals [P, 3] at the tracks' points, towards the cameras, of planes through the nearest scene points.

    Beside an edge some of these are on another surface: they count little (iteratively reweighted least squares). Of points that
    are a few millimetres off, more of them tell the plane better.
    """
    tracks, points = obs.tracks, obs.scene.points.double()
    if tracks is None or obs.still or len(points) < MIN_POINTS:
        return None
    points = points[torch.tensor(evenly_spread(len(points), MAX_IN_FRONT))]
    seen = functional.normalize((tracks.directions * tracks.weights[..., None]).sum(1), dim=1)
    return on_the_side_of(_planes(points, tracks.points), seen)


def _planes(points: Tensor, at: Tensor) -> Tensor:
    """Normals [n, 3], of either sign, of the surfaces through points [P, 3] nearest to each of ``at`` [n, 3]."""
    axes, _ = plane_axes(points, at, NEIGHBOURS + 1)
    found, middle = axes[..., 2], torch.zeros_like(at)
    _, near = cKDTree(points.numpy()).query(at.numpy(), k=min(WIDER + 1, len(points)))
    around = points[torch.from_numpy(near)] - at[:, None]
    for _ in range(ROUNDS):
        off = ((around - middle[:, None]) * found[:, None]).sum(2)
        usual = MAD_TO_SIGMA * off[:, : NEIGHBOURS + 1].abs().median(1, keepdim=True).values
        weights = (1.0 + (off / (OFF * usual).clamp_min(1e-12)) ** 2) ** -2
        middle = (weights[..., None] * around).sum(1) / weights.sum(1, keepdim=True)
        rest = weights.sqrt()[..., None] * (around - middle[:, None])
        _, axes = torch.linalg.eigh(rest.mT @ rest)
        found = axes[..., 0]
    return found
