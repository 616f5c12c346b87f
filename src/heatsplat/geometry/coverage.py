"""Which pixels of a new view show what some training camera has seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor
from torch.nn.functional import max_pool2d

from heatsplat.contracts import Camera
from heatsplat.geometry.projection import eyes, to_camera, to_pixels, to_world
from heatsplat.geometry.sight_lines import rays

OPEN = 0.5  # a pixel with less opacity than this shows no surface, but what is far behind everything
DEPTH_TOLERANCE = 0.05  # of the depth: what lies so little behind a surface belongs to it
MOSTLY = 0.5  # share of what a pixel shows of which a quantity must be known for the pixel to have one
FAR = 1e6  # depth of a pixel without a surface, in distances between the cameras
TILE = 16  # side in pixels of what is looked for in training images as one, before its pixels are
TOGETHER = 64  # training cameras in whose images tiles are looked for at once
ROUNDING = 1e-9  # of coordinates, by which a tile's box is widened


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

    @cached_property
    def around(self) -> tuple[Tensor, Tensor]:
        """The nearest and the farthest depth [H, W] of each pixel and its neighbours: every new view asks for them."""
        nearest, farthest = (
            sign * max_pool2d(sign * self.depth[None, None], 3, stride=1, padding=1)[0, 0] for sign in (-1.0, 1.0)
        )
        return nearest, farthest


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
    z = depth.detach().cpu().double().reshape(-1)
    is_open = z.isinf()
    order, apart = _by_likeness(camera, [sighting.camera for sighting in sightings])
    reach = torch.where(is_open, FAR * max(apart, 1.0), z)
    points = to_world(rays(camera).reshape(-1, 3) * reach[:, None], camera.viewmat)

    # Most of what is never found lies in few images, such as sky: to look for it in all takes seconds (700 images).
    rows, columns = torch.arange(camera.height)[:, None], torch.arange(camera.width)
    tiles = (rows // TILE * (camera.width // TILE + 1) + columns // TILE).reshape(-1)
    tiles = torch.where(is_open, -1 - tiles, tiles)  # sky and surfaces of a tile are far apart
    left = tiles.argsort(stable=True)  # not found yet, tile by tile
    start, count = 0, 1
    while start < len(order) and len(left):
        among = [sightings[k] for k in order[start : start + count]]
        start, count = start + count, min(2 * count, TOGETHER)
        left = left[_unseen(among, points[left], is_open[left], tiles[left])]
    found = torch.ones(camera.height * camera.width, dtype=torch.bool)
    found[left] = False
    return found.reshape(camera.height, camera.width)


def _unseen(sightings: Sequence[Sighting], points: Tensor, is_open: Tensor, tiles: Tensor) -> Tensor:
    """Which of the points [P, 3] no training camera sees, [P] bool; those of a tile [P] lie one after the other."""
    _, tiles, counts = tiles.unique_consecutive(return_inverse=True, return_counts=True)
    members = torch.arange(len(points)).split(counts.tolist())
    unseen = torch.ones(len(points), dtype=torch.bool)
    for sighting, reaches in zip(sightings, _in_images(sightings, points, tiles, len(members)), strict=True):
        there = reaches.nonzero().squeeze(1).tolist()
        if there:
            ids = torch.cat([members[tile] for tile in there])
            ids = ids[unseen[ids]]
            unseen[ids] = ~_sees(sighting, points[ids], is_open[ids])
    return unseen


def _in_images(sightings: Sequence[Sighting], points: Tensor, tiles: Tensor, count: int) -> Tensor:
    """Which tiles may have a point in which images, [n, count] bool; as their boxes are looked for, some have none.

    Args:
        points, tiles: [P, 3], and the tile [P] that each belongs to.
    """
    low, high = (
        points.new_zeros(count, 3).scatter_reduce_(0, tiles[:, None].expand(-1, 3), points, end, include_self=False)
        for end in ("amin", "amax")
    )
    middle = 0.5 * (low + high)
    half = 0.5 * (high - low) + ROUNDING * middle.abs()
    planes = torch.stack([_sides(sighting.camera) for sighting in sightings])
    normals, offsets = planes[..., :3], planes[..., 3:]
    most = normals @ middle.T + normals.abs() @ half.T + offsets + ROUNDING * offsets.abs()
    return ~(most < 0).any(1)


def _sides(camera: Camera) -> Tensor:
    """Planes [5, 4] that bound what a camera sees: left, right, top, bottom and its own; (x, y, z, 1) of it is not below 0."""
    (fx, cx), (fy, cy) = ((float(camera.K[i, i]), float(camera.K[i, 2])) for i in (0, 1))
    inward = [[fx, 0, cx], [-fx, 0, camera.width - cx], [0, fy, cy], [0, -fy, camera.height - cy], [0, 0, 1]]
    return torch.tensor(inward, dtype=torch.float64) @ camera.viewmat[:3]


def _by_likeness(camera: Camera, others: Sequence[Camera]) -> tuple[list[int], float]:
    """Other cameras from the most to the least like one, and the distance to the farthest of them.

    Only how soon all pixels are found depends on this order.
    """
    if not others:
        return [], 0.0
    matrices = torch.stack([other.viewmat for other in others])
    apart = (eyes(matrices) - camera.center).norm(dim=1)
    turned = 1.0 - matrices[:, 2, :3] @ camera.viewmat[2, :3]
    return (turned + apart / (1.0 + camera.center.norm())).argsort(stable=True).tolist(), float(apart.max())


def _sees(sighting: Sighting, points: Tensor, is_open: Tensor) -> Tensor:
    """Which of the points [P, 3] a training camera sees, [P] bool; ``is_open`` [P] tells which stand for directions."""
    camera = sighting.camera
    local = to_camera(points, camera.viewmat)
    pixels = to_pixels(local, camera.K)
    ids = camera.inside(pixels, local[:, 2]).nonzero().squeeze(1)
    column, row = pixels[ids].long().unbind(-1)
    # The farthest of the pixel and its neighbours: at an edge the coarse grid cannot tell them apart. A direction must be
    # free in all of them: holes between Gaussians, and the ragged end of what is reconstructed, have some open pixels.
    nearest, farthest = sighting.around
    reach = torch.where(is_open[ids], nearest[row, column], farthest[row, column]).double()
    visible = local[ids, 2] <= (1.0 + DEPTH_TOLERANCE) * reach
    if sighting.mask is not None:
        visible &= sighting.mask[row, column]
    seen = torch.zeros(len(points), dtype=torch.bool)
    seen[ids] = visible
    return seen
