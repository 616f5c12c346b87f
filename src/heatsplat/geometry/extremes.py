"""Which surfaces of a scene are hottest and coldest, where they lie and how large they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from heatsplat.geometry.looks import Look, surface_points

EDGE = 0.1  # step of depth from pixel to pixel, of the depth, from which on they are two surfaces
STEEPEST = 10.0  # times its frontal area that a pixel shows at most: beyond, depth is noise
CELLS = 3.0  # widths of a pixel in a cell by which pixels are joined
LEAST = 12  # pixels of a surface


@dataclass(frozen=True)
class Surface:
    """A connected surface.

    Args:
        centre: [3] in the world: of its pieces the one nearest to their centre of mass, which may lie in the air.
        area: in units of the world, squared.
        mean: of its values.
        most: what its hottest (coldest) fiftieth exceeds.
    """

    centre: Tensor
    area: float
    mean: float
    most: float


def extremes(
    looks: Sequence[Look], share: float = 0.05, count: int = 4, box: tuple[Tensor, Tensor] | None = None
) -> tuple[list[Surface], list[Surface]]:
    """The hottest and the coldest surfaces, the largest ``count`` of each, from the most extreme mean on.

    Every pixel is a piece of surface whose area follows from its neighbours' depths; a piece that several looks see
    counts once in all. One that a single look sees counts only where no other look has something else before or behind it.
    The hottest (coldest) ``share`` of the whole area is joined where pieces touch.

    Args:
        looks: of the scene, at one moment.
        share: of the area.
        count: of surfaces.
        box: lowest and highest corner [3] of where surfaces may lie: those that a look shows far beside the reconstruction, such
            as under the ground at the border of an image, are none. None: anywhere.
    """
    parts = [_pieces(look) for look in looks]
    points, areas, values, widths = (torch.cat(column) for column in zip(*parts, strict=True))
    if box is not None:
        inside = ((points >= box[0]) & (points <= box[1])).all(1)
        points, areas, values, widths = points[inside], areas[inside], values[inside], widths[inside]
    if not len(points):
        return [], []
    seen = sum(look.sees(points)[0].long() for look in looks)
    # Depths of a grazing look lie easily below the ground, in the air or in a wall: what one look alone sees, and another
    # one denies, is no surface.
    real = (seen > 1) | ~torch.stack([look.denies(points) for look in looks]).any(0)
    points, areas, values, widths = points[real], (areas / seen.clamp(min=1))[real], values[real], widths[real]
    if not len(points):
        return [], []
    cell = CELLS * widths.median().item()
    order = values.argsort()
    reached = areas[order].cumsum(0) / areas.sum()
    # The whole may be a little less than 1, by rounding.
    low, high = (values[order[min(int((reached < part).sum()), len(order) - 1)]] for part in (share, 1 - share))
    return tuple(
        _joined(points[chosen], areas[chosen], values[chosen], cell, count, sign)
        for chosen, sign in ((values >= high, 1), (values <= low, -1))
    )


def _pieces(look: Look) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Points [n, 3] in the world, areas, values and widths [n] of the pixels that show a surface."""
    camera, depth = look.camera, look.depth.double()
    found = depth.isfinite() & look.values.isfinite()
    points = surface_points(camera, depth.where(found, 0.0))
    across, down = points[:-1, 1:] - points[:-1, :-1], points[1:, :-1] - points[:-1, :-1]
    areas = torch.linalg.cross(across, down).norm(dim=-1)
    here = depth[:-1, :-1]
    steps = torch.maximum((depth[:-1, 1:] - here).abs(), (depth[1:, :-1] - here).abs())
    frontal = here.square() / (camera.K[0, 0] * camera.K[1, 1]).double()
    kept = found[:-1, :-1] & found[1:, :-1] & found[:-1, 1:] & (steps < EDGE * here) & (areas < STEEPEST * frontal)
    return points[:-1, :-1][kept], areas[kept], look.values[:-1, :-1][kept].double(), frontal[kept].sqrt()


def _joined(points: Tensor, areas: Tensor, values: Tensor, cell: float, count: int, sign: int) -> list[Surface]:
    cells, of_point = np.unique((points / cell).floor().long().numpy(), axis=0, return_inverse=True)
    of_point = of_point.reshape(-1)
    pairs = cKDTree(cells).query_pairs(1.8, output_type="ndarray")  # neighbours by face, edge and corner
    touching = coo_array((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2)
    labels = torch.from_numpy(connected_components(touching, directed=False)[1].astype(np.int64)[of_point])
    numbers = torch.bincount(labels)
    total = torch.zeros(len(numbers), dtype=torch.float64).index_add(0, labels, areas)
    total[numbers < LEAST] = 0
    found = []
    for label in total.argsort(descending=True)[:count].tolist():
        if total[label] > 0:
            mine = labels == label
            weights = areas[mine] / total[label]
            most = sign * float(np.quantile((sign * values[mine]).numpy(), 0.98))
            mean = (weights * values[mine]).sum().item()
            middle = (weights[:, None] * points[mine]).sum(0)
            centre = points[mine][(points[mine] - middle).norm(dim=1).argmin()]
            found.append(Surface(centre, total[label].item(), mean, most))
    return sorted(found, key=lambda one: -sign * one.mean)
