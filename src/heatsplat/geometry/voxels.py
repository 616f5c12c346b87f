"""Cubes that part space: which of them points lie in."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor


def spacing(points: Tensor) -> float:
    """Median distance of points [P, 3] to the nearest other one, in their unit; 0 where most lie on another, or for one."""
    if len(points) < 2:
        return 0.0
    array = points.double().cpu().numpy()
    distances, _ = cKDTree(array).query(array, k=2, workers=1)
    return float(torch.from_numpy(distances[:, 1]).median())


def cells(points: Tensor, size: float) -> Tensor:
    """Numbers [P, 3] int64 of the cubes of edge ``size`` that points [P, 3] lie in; the cube of zeros is about the origin."""
    return (points.double() / size).round().long()


def middles(cells: Tensor, size: float) -> Tensor:
    """Centres [P, 3] of cubes with these numbers, float32."""
    return (cells.double() * size).float()


def among(cells: Tensor, others: Tensor) -> Tensor:
    """Which of the rows [P, 3] are rows of ``others`` [Q, 3], [P] bool."""
    both, place = torch.unique(torch.cat((others, cells)), dim=0, return_inverse=True)
    taken = torch.zeros(len(both), dtype=torch.bool, device=cells.device)
    taken[place[: len(others)]] = True
    return taken[place[len(others) :]]
