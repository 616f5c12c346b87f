"""Along each pixel of a depth map: how far its surface is, and at which angle it is seen."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.contracts import Camera

REACH = 2  # pixels to either side over which a slope is taken: depth maps of Gaussians are rough from one to the next
BREAK = 0.05  # of 1 / depth, which is linear over the image of a plane: what bends more over the reach is an edge


def rays(camera: Camera) -> Tensor:
    """Points [H, W, 3] of camera z 1 on the lines of sight through the middles of pixels, in the camera's frame, float64."""
    rows, columns = torch.meshgrid(
        torch.arange(camera.height, dtype=torch.float64), torch.arange(camera.width, dtype=torch.float64), indexing="ij"
    )
    pixels = torch.stack([columns + 0.5, rows + 0.5, torch.ones_like(rows)], dim=-1)
    return pixels @ torch.linalg.inv(camera.K.double()).T


def distances(camera: Camera, depth: Tensor) -> Tensor:
    """Distances [H, W] from the camera's centre of what has a camera z [H, W]; infinite where there is no surface."""
    return depth.double() * rays(camera).norm(dim=-1)


def cosines(camera: Camera, depth: Tensor) -> Tensor:
    """Cosine [H, W] of the angle between the line of sight and the surface's normal, in [0, 1]; NaN where it is not known.

    The normal is that of the plane through the points ``REACH`` pixels to the left and right and above and below.

    Args:
        depth: [H, W] camera z, infinite where there is no surface.
    """
    sight = rays(camera)
    points = sight * depth.double()[..., None]
    found = torch.full(depth.shape, torch.nan, dtype=torch.float64)
    if min(depth.shape) <= 2 * REACH:
        return found
    inner, r = slice(REACH, -REACH), REACH
    right = points[inner, 2 * r :] - points[inner, : -2 * r]
    down = points[2 * r :, inner] - points[: -2 * r, inner]
    normal = torch.linalg.cross(right, down)
    view = torch.nn.functional.normalize(sight[inner, inner], dim=-1)
    cosine = (torch.nn.functional.normalize(normal, dim=-1) * view).sum(-1).abs()
    inverse = 1.0 / depth.double()
    middle = inverse[inner, inner]
    bend_x = inverse[inner, 2 * r :] + inverse[inner, : -2 * r] - 2 * middle
    bend_y = inverse[2 * r :, inner] + inverse[: -2 * r, inner] - 2 * middle
    known = normal.isfinite().all(-1) & (torch.maximum(bend_x.abs(), bend_y.abs()) < BREAK * middle)
    found[inner, inner] = torch.where(known, cosine.clamp(0.0, 1.0), torch.nan)
    return found
