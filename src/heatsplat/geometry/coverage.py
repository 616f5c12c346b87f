"""Which pixels of a new view show what some training camera has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from heatsplat.contracts import Camera
from heatsplat.geometry.projection import to_camera, to_pixels

OPEN = 0.5  # a pixel with less opacity than this shows no surface, but what is far behind everything
DEPTH_TOLERANCE = 0.05  # of the depth: what lies so little behind a surface belongs to it
MOSTLY = 0.5  # share of what a pixel shows of which a quantity must be known for the pixel to have one
FAR = 1e6  # depth of a pixel without a surface, in distances between the cameras


@dataclass(frozen=True)
class Sighting:
    """What one training camera has seen.

    Args:
        camera: on the grid of the depth map, which may be coarser than the image.
        depth: [H, W] camera z of the surface; infinite where there is none.
        mask: [H, W] bool, True where the image counts; None means everywhere.
    """

    camera: Camera
    depth: Tensor
    mask: Tensor | None = None


def surface_depth(depth: Tensor, alpha: Tensor) -> Tensor:
    """Camera z [H, W] of what a renderer shows, from its accumulated depth and opacity; infinite where it is open."""
    return torch.where(alpha >= OPEN, depth / alpha.clamp(min=OPEN), torch.inf)


def gap_free(columns: Tensor) -> Tensor:
    """Columns [N, C] for a renderer that adds them up: where some are not finite 0 in their place, and [N, C] more that say
    which are known; else the columns themselves. ``seen_means`` takes what was rendered."""
    known = columns.isfinite()
    return columns if known.all() else torch.cat([columns.where(known, 0.0), known.to(columns)], dim=1)


def seen_means(features: Tensor, alpha: Tensor, count: int) -> Tensor:
    """Means [H, W, C] over those Gaussians of a pixel of which a quantity is known; NaN where there are none, or too few of them.

    Args:
        features: [H, W, C or 2 C] as rendered of ``gap_free``'s columns.
        alpha: [H, W] opacity.
        count: C.
    """
    alpha = alpha[..., None]
    weights = features[..., count:] if features.shape[-1] > count else alpha
    return (features[..., :count] / weights).where((alpha > 0) & (weights >= MOSTLY * alpha), torch.nan)


def covered(camera: Camera, depth: Tensor, sightings: Sequence[Sighting]) -> Tensor:
    """Pixels [H, W] whose surface point lies in the image of some training camera and is not hidden from it; bool.

    **Convention:** a pixel without a surface is a direction: it is covered where a training camera looked in that direction
    and saw no surface around it either, so that a hole in what was reconstructed is no sky. What lies within
    ``DEPTH_TOLERANCE`` behind a surface counts as that surface, so that the grid of the depth maps does not matter.

    Args:
        camera: of the new view.
        depth: [H, W] of the new view, as ``surface_depth`` gives it.
        sightings: of the training cameras.
    """
    rows, columns = torch.meshgrid(
        torch.arange(camera.height, dtype=torch.float64), torch.arange(camera.width, dtype=torch.float64), indexing="ij"
    )
    pixels = torch.stack([columns + 0.5, rows + 0.5, torch.ones_like(rows)], dim=-1).reshape(-1, 3)
    rays = pixels @ torch.linalg.inv(camera.K).T
    z = depth.detach().cpu().double().reshape(-1)
    is_open = z.isinf()
    reach = FAR * max([float((other.camera.center - camera.center).norm()) for other in sightings] + [1.0])
    points = (rays * torch.where(is_open, reach, z)[:, None] - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]

    found = torch.zeros(len(points), dtype=torch.bool)
    for sighting in sorted(sightings, key=lambda other: _difference(camera, other.camera)):
        left = (~found).nonzero().squeeze(1)
        if not len(left):
            break
        found[left] = _sees(sighting, points[left], is_open[left])
    return found.reshape(camera.height, camera.width)


def _difference(one: Camera, other: Camera) -> float:
    """How unlike two views are; only the order in which cameras are asked depends on it."""
    turned = 1.0 - float(one.viewmat[2, :3] @ other.viewmat[2, :3])
    return turned + float((one.center - other.center).norm()) / (1.0 + float(one.center.norm()))


def _sees(sighting: Sighting, points: Tensor, is_open: Tensor) -> Tensor:
    """Which of the points [P, 3] a training camera sees, [P] bool; ``is_open`` [P] tells which stand for directions."""
    camera = sighting.camera
    local = to_camera(points, camera.viewmat)
    column, row = to_pixels(local, camera.K).floor().nan_to_num(-1.0).clamp(-1, 2**31).long().unbind(-1)
    inside = (local[:, 2] > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    ids = inside.nonzero().squeeze(1)
    row, column = row[ids], column[ids]
    # The farthest of the pixel and its neighbours: at an edge the coarse grid cannot tell them apart. A direction must be
    # free in all of them: holes between Gaussians, and the ragged end of what is reconstructed, have some open pixels.
    depth = sighting.depth.double()[None, None]
    farthest, nearest = (sign * max_pool2d(sign * depth, 3, stride=1, padding=1)[0, 0] for sign in (1.0, -1.0))
    reach = torch.where(is_open[ids], nearest[row, column], farthest[row, column])
    visible = local[ids, 2] <= (1.0 + DEPTH_TOLERANCE) * reach
    if sighting.mask is not None:
        visible &= sighting.mask[row, column]
    seen = torch.zeros(len(points), dtype=torch.bool)
    seen[ids] = visible
    return seen
