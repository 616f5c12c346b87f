"""Nearest neighbours of points: how far they are, and who they are as a graph; all in float64 on the CPU."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor


def neighbour_distances(points: Tensor, neighbours: int = 3) -> Tensor:
    """Distances from each point to its nearest others, [P, neighbours]; fewer columns when there are fewer points."""
    array = points.double().numpy()
    k = min(neighbours, len(array) - 1)
    distances, _ = cKDTree(array).query(array, k=list(range(1, k + 2)), workers=1)  # a list keeps two axes
    return torch.from_numpy(distances[:, 1:]).float()


def neighbour_pairs(means: Tensor, neighbours: int) -> Tensor:
    """Pairs [E, 2] int64 of centres, one of which is among the nearest of the other: first below second, each once, ascending.

    Args:
        means: [N, 3], finite.
        neighbours: how many nearest are looked at.
    """
    centres = means.cpu().double().numpy()
    count = len(centres)
    near = torch.from_numpy(cKDTree(centres).query(centres, k=min(neighbours + 1, count), workers=1)[1])
    near = near.reshape(count, -1)
    here = torch.arange(count)[:, None]
    keys = (torch.minimum(here, near) * count + torch.maximum(here, near))[here != near]
    keys = keys.unique()  # of pairs it would take a hundred times as long
    return torch.stack([keys // count, keys % count], dim=1).to(means.device)


def proximity_graph(means: Tensor, neighbours: int) -> tuple[Tensor, Tensor]:
    """Lengths [N, K] and ends [N, K] int64 of the edges from each centre to its K nearest others, nearest first.

    With fewer than K + 1 centres K is what there is. A centre that is not finite has edges of length zero to itself,
    and no other centre points to it. Coinciding centres are neighbours at distance zero; none is its own neighbour.

    Args:
        means: [N, 3].
        neighbours: K.
    """
    finite = torch.isfinite(means).all(dim=1).nonzero().squeeze(1)
    k = max(0, min(neighbours, len(finite) - 1))
    ends = torch.arange(len(means), device=means.device)[:, None].repeat(1, k)
    lengths = means.new_zeros(len(means), k)
    if k == 0:
        return lengths, ends
    centres = means[finite].cpu().double().numpy()
    distances, ids = cKDTree(centres).query(centres, k=k + 1, workers=torch.get_num_threads())
    distances, ids = torch.from_numpy(distances), torch.from_numpy(ids)
    # The centre itself is among the nearest, but not always the first where centres coincide; with more coinciding ones
    # than neighbours it may be missing, and then the last is left out.
    own = ids == torch.arange(len(ids))[:, None]
    own[:, -1] |= ~own.any(dim=1)
    others = ~own
    lengths[finite] = distances[others].reshape(-1, k).to(means)
    ends[finite] = finite[ids[others].reshape(-1, k).to(finite.device)]
    return lengths, ends
