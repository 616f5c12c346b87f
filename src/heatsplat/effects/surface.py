"""Which way the surface faces at the points that are followed."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import evenly_spread
from heatsplat.effects.observations import MAX_IN_FRONT, Observations
from heatsplat.geometry.surfaces import on_the_side_of, plane_axes

NEIGHBOURS = 8
MIN_POINTS = 12  # points below which no surface can be told


def normals(obs: Observations) -> Tensor | None:
    """Unit normals [P, 3] at the tracks' points, towards the cameras, of planes through the nearest scene points."""
    tracks, points = obs.tracks, obs.scene.points.double()
    if tracks is None or obs.still or len(points) < MIN_POINTS:
        return None
    points = points[torch.tensor(evenly_spread(len(points), MAX_IN_FRONT))]
    axes, _ = plane_axes(points, tracks.points, NEIGHBOURS + 1)
    seen = functional.normalize((tracks.directions * tracks.weights[..., None]).sum(1), dim=1)
    return on_the_side_of(axes[..., 2], seen)
