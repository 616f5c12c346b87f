"""Points to start from, where they do not come with a sparse model."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from plyfile import PlyData

from heatsplat.contracts import SceneError
from heatsplat.training.rng import generator_for


def random_points(viewmats: Sequence[np.ndarray], count: int, seed: int) -> np.ndarray:
    """Points [count, 3] float64, uniform in the cube that the cameras look at.

    Its centre is the point nearest to all optical axes. Axes that are nearly parallel do not say how far away it is, so
    a weak prior pulls it to twice the cameras' radius in front of them. Half its side is the median distance of the
    cameras to the centre, and at least their radius.

    Args:
        viewmats: world-to-camera [4, 4] of each frame.
        count: number of points.
        seed: the run's seed.
    """
    rotations = np.stack([v[:3, :3] for v in viewmats])
    centers = np.stack([-np.linalg.inv(v[:3, :3]) @ v[:3, 3] for v in viewmats])
    axes = rotations[:, 2] / np.linalg.norm(rotations[:, 2], axis=1, keepdims=True)
    middle = centers.mean(axis=0)
    radius = max(np.linalg.norm(centers - middle, axis=1).max(), 1e-3)
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    prior, weight = middle + 2.0 * radius * axes.mean(axis=0), 0.05
    system = across.mean(axis=0) + weight * np.eye(3)
    centre = np.linalg.solve(system, (across @ centers[..., None]).mean(axis=0)[:, 0] + weight * prior)
    half = max(np.median(np.linalg.norm(centers - centre, axis=1)), radius)
    unit = torch.rand((count, 3), generator=generator_for(seed, 0, "random points"), dtype=torch.float64)
    return centre + half * (2.0 * unit.numpy() - 1.0)


def told_random(count: int, why: str) -> dict[str, Any]:
    """Notes of points that were made up: nothing may be judged by where they lie."""
    return {"points_source": f"{count} random points in the cube that the cameras look at{why}", "points_random": count}


def obj_vertices(path: Path) -> np.ndarray:
    """Vertices [P, 3] float64 of a Wavefront .obj file. Raises SceneError when a vertex line is damaged."""
    vertices = []
    with path.open(encoding="utf-8", errors="replace") as file:
        for number, line in enumerate(file, start=1):
            if line.startswith("v "):
                try:
                    x, y, z = map(float, line.split()[1:4])
                except ValueError as error:
                    raise SceneError(f"{path}, line {number}: {line.strip()!r} is no vertex") from error
                vertices.append((x, y, z))
    return np.array(vertices, dtype=np.float64).reshape(-1, 3)


def ply_points(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Points [P, 3] float64 and colours [P, 3] in [0, 1] (or None) of a .ply file, which has them so or up to 255. Raises
    SceneError when damaged."""
    try:
        vertex = PlyData.read(str(path))["vertex"]
        points = np.stack([vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)
        colours = None
        if {"red", "green", "blue"} <= set(vertex.data.dtype.names):
            colours = np.stack([vertex[c] for c in ("red", "green", "blue")], axis=1)
            shares = colours.dtype.kind == "f" and colours.size and colours.max() <= 1.0
            colours = colours.astype(np.float64) / (1.0 if shares else 255.0)
    except Exception as error:  # the reader has many of its own, and MemoryError for a count that is no count
        raise SceneError(f"{path} is no readable point cloud: {error}") from error
    if colours is not None and not ((colours >= 0) & (colours <= 1)).all():
        raise SceneError(f"{path}: red, green and blue must lie between 0 and 255")
    return points, colours
