"""Which way surfaces lie: planes through neighbouring points, and what a depth map says of its surface. Pure functions."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from heatsplat.contracts import Camera
from heatsplat.geometry.coverage import surface_depth

# Second semi-axis of a neighbourhood, as a share of its first, below which its points lie on a line and make no plane.
LEAST_WIDTH = 1e-3


def plane_axes(points: Tensor, at: Tensor, neighbours: int) -> tuple[Tensor, Tensor]:
    """Planes of the points [P, 3] about each of ``at`` [n, 3], by principal axes.

    Every point has a plane, through those nearest to it. A place takes the mean of its neighbours' planes, and almost alone of
    those that are thin and pass close: beside an edge, of neighbours farther away from it, where its own would cut the corner.

    Returns:
        Rotations [n, 3, 3] float64 whose last column is the normal, of either sign, and the others two axes in the plane; and
        the distances [n] to the neighbours, root mean square.

    Args:
        neighbours: points of a plane, at most all there are; fewer than three make no plane.
    """
    every, squares, _, middles = _principal_axes(points, points, neighbours)
    distances, near = _nearest(points, at, neighbours)
    normals = every[..., 2][near]
    across = ((at.double()[:, None] - middles[near]) * normals).sum(-1)
    apart = squares[near, 2] / near.shape[1] + across.square()
    share = torch.where(apart > 0, apart.min(1, keepdim=True).values / apart, 1.0)
    normals = share[..., None] * normals
    axes = torch.linalg.eigh(normals.mT @ normals)[1]  # the last is the one along which most of them lie
    axes[:, :, 2] *= torch.linalg.det(axes).sign()[:, None]
    return axes, distances.square().mean(1).sqrt()


def plane_thickness(points: Tensor, at: Tensor, neighbours: int) -> tuple[Tensor, Tensor]:
    """Axes of the points [P, 3] nearest to each of ``at`` [n, 3], and how thick they are across their plane.

    Returns:
        Rotations [n, 3, 3] float64 whose columns are the axes, widest first; and shares [n] float64, in [0, 1], of the standard
        deviation across a plane in the smaller one in it: 0 where points lie in a plane, about 0.7 where ten lie anywhere, and 1
        where they lie on a line.

    Args:
        points, at, neighbours: as of ``plane_axes``.
    """
    axes, squares, *_ = _principal_axes(points, at, neighbours)
    widest, wide, thin = squares.unbind(1)
    flat = wide > LEAST_WIDTH**2 * widest
    return axes, torch.where(flat, thin / torch.where(flat, wide, 1.0), 1.0).sqrt()


def _nearest(points: Tensor, at: Tensor, neighbours: int) -> tuple[Tensor, Tensor]:
    """Distances [n, k] to the points nearest to each of ``at``, and which they are, [n, k]."""
    found = cKDTree(points.double().numpy()).query(at.double().numpy(), k=min(neighbours, len(points)))
    distances, near = (torch.from_numpy(one).reshape(len(at), -1) for one in found)
    return distances, near


def _principal_axes(points: Tensor, at: Tensor, neighbours: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Axes [n, 3, 3] of the points nearest to each of ``at``, sums of squares [n, 3] along them, distances [n], means [n, 3]."""
    distances, near = _nearest(points, at, neighbours)
    around = points.double()[near]
    middles = around.mean(1)
    around = around - middles[:, None]
    squares, axes = torch.linalg.eigh(around.mT @ around)
    axes = axes.flip(-1)
    turn = torch.ones(len(at), 3, dtype=torch.float64)
    turn[:, 2] = torch.linalg.det(axes).sign()
    return axes * turn[:, None], squares.flip(-1).clamp(min=0.0), distances.square().mean(1).sqrt(), middles


def on_the_side_of(normals: Tensor, directions: Tensor) -> Tensor:
    """Normals [..., 3], turned round where they point away from ``directions`` [..., 3] (of any length)."""
    return torch.where((normals * directions).sum(-1, keepdim=True) < 0, -normals, normals)


def depth_normals(depth: Tensor, alpha: Tensor, camera: Camera) -> Tensor:
    """Unit normals [H, W, 3] in the world, towards the camera, of the surface that a renderer shows; 0 where it is open.

    They are those of the planes through the neighbours on either side, in rows and in columns.

    Args:
        depth: [H, W] accumulated camera z.
        alpha: [H, W] accumulated opacity.
    """
    z = surface_depth(depth, alpha)
    rows, columns = torch.meshgrid(
        torch.arange(camera.height).to(z) + 0.5, torch.arange(camera.width).to(z) + 0.5, indexing="ij"
    )
    rays = torch.stack([columns, rows, torch.ones_like(rows)], dim=-1) @ torch.linalg.inv(camera.K).to(z).T
    places = rays * z[..., None]
    down, across = torch.gradient(places, dim=(0, 1))
    normals = torch.nn.functional.normalize(torch.linalg.cross(down, across), dim=-1)
    return (on_the_side_of(normals, -rays) @ camera.viewmat[:3, :3].to(z)).nan_to_num(0.0)
