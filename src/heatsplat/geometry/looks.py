"""What cameras see of surfaces at a moment: depth and a value in every pixel, and what that says of points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from heatsplat.contracts import Camera
from heatsplat.geometry.coverage import DEPTH_TOLERANCE
from heatsplat.geometry.projection import to_camera, to_pixels, to_world
from heatsplat.geometry.sight_lines import rays

GRAZING = 0.1  # cosine between a surface's normal and the way to a camera below which that sees nothing of it


@dataclass(frozen=True)
class Look:
    """What a camera sees.

    Args:
        camera: of the image.
        depth: [H, W] camera z of the surface; infinite where there is none.
        values: [H, W] such as its temperature.
    """

    camera: Camera
    depth: Tensor
    values: Tensor

    def sees(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Which points [n, 3] of surfaces it sees, [n] bool, and the values [n] of their pixels."""
        inside, z, place = self._places(points)
        there, found = self.depth[place].double(), self.values[place].double()
        return inside & found.isfinite() & ((z - there).abs() <= DEPTH_TOLERANCE * there), found

    def denies(self, points: Tensor) -> Tensor:
        """Which points [n, 3] lie in its image where it shows a surface elsewhere, before or behind them; [n] bool."""
        inside, z, place = self._places(points)
        there = self.depth[place].double()
        return inside & there.isfinite() & ((z - there).abs() > DEPTH_TOLERANCE * there)

    def _places(self, points: Tensor) -> tuple[Tensor, Tensor, tuple[Tensor, Tensor]]:
        """Of points [n, 3] whether they lie in the image, their camera z, and row and column, within the image."""
        camera = self.camera
        local = to_camera(points.double(), camera.viewmat)
        pixels = to_pixels(local, camera.K)
        column, row = pixels.nan_to_num(0).clamp(0, 1e6).long().unbind(-1)
        place = row.clamp(max=camera.height - 1), column.clamp(max=camera.width - 1)
        return camera.inside(pixels, local[:, 2]), local[:, 2], place


def surface_points(camera: Camera, depth: Tensor) -> Tensor:
    """Points [H, W, 3] of the world, float64, at a depth (camera z, [H, W]) in the middle of each pixel of a camera."""
    return to_world(rays(camera) * depth.double()[..., None], camera.viewmat)


def values_at(looks: Sequence[Look], points: Tensor, normals: Tensor | None = None) -> Tensor:
    """Values [n] of points [n, 3] of surfaces, float64: means over the looks that see them, NaN where none does.

    A look counts by how large it sees the surface: the cosine to its normal over the squared distance.

    Args:
        looks: at one moment.
        points: in the world.
        normals: [n, 3] outward, of length 1; a camera behind sees nothing. None: every camera is before the surface.
    """
    sums, weights = torch.zeros(2, len(points), dtype=torch.float64)
    for look in looks:
        seen, values = look.sees(points)
        way = look.camera.center - points.double()
        distance = way.norm(dim=1).clamp(min=1e-12)
        cosine = 1.0 if normals is None else (way * normals.double()).sum(1) / distance
        if normals is not None:
            seen &= cosine > GRAZING
        weight = (cosine / distance.square()).where(seen, torch.zeros(()).double())
        sums += weight * values.nan_to_num()
        weights += weight
    return (sums / weights).where(weights > 0, torch.nan)
