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
    """Planes through the points [P, 3] nearest to each of ``at`` [n, 3], by principal axes.

    Returns:
        Rotations [n, 3, 3] float64 whose columns are the axes, widest first, so that the last is the normal, of either
        sign; and the distances [n] to the neighbours, root mean square.

    Args:
        neighbours: points of a plane, at most all there are; fewer than three make no plane.
    """
    axes, _, far = _principal_axes(points, at, neighbours)
    return axes, far


def plane_thickness(points: Tensor, at: Tensor, neighbours: int) -> tuple[Tensor, Tensor]:
    """The axes of ``plane_axes``, and how thick neighbourhoods are across their planes.

    Returns:
        Rotations [n, 3, 3] float64, as there; and shares [n] float64, in [0, 1], of the standard deviation across a plane in the
        smaller one in it: 0 where points lie in a plane, about 0.7 where ten lie anywhere, and 1 where they lie on a line.

    Args:
        points: [P, 3]. at: [n, 3]. neighbours: as there.
    """
    axes, squares, _ = _principal_axes(points, at, neighbours)
    widest, wide, thin = squares.unbind(1)
    flat = wide > LEAST_WIDTH**2 * widest
    return axes, torch.where(flat, thin / torch.where(flat, wide, 1.0), 1.0).sqrt()


def _principal_axes(points: Tensor, at: Tensor, neighbours: int) -> tuple[Tensor, Tensor, Tensor]:
    """Axes [n, 3, 3] of the points nearest to each of ``at``, sums of squares [n, 3] along them, and distances [n]."""
    distances, near = cKDTree(points.double().numpy()).query(at.double().numpy(), k=min(neighbours, len(points)))
    around = points.double()[torch.from_numpy(near).reshape(len(at), -1)]
    around = around - around.mean(1, keepdim=True)
    squares, axes = torch.linalg.eigh(around.mT @ around)
    axes = axes.flip(-1)
    turn = torch.ones(len(at), 3, dtype=torch.float64)
    turn[:, 2] = torch.linalg.det(axes).sign()
    far = torch.from_numpy(distances).reshape(len(at), -1).square().mean(1).sqrt()
    return axes * turn[:, None], squares.flip(-1).clamp(min=0.0), far


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
