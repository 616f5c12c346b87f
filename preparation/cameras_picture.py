"""Picture of the cameras that were found, over the points that they share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from heatsplat.preparation.report import save_picture

SHOWN = 0.98  # share of the points that the frame of the picture holds
SIGHT = 0.08  # length of a camera's line of sight, as a share of the picture


def draw_cameras(path: Path, viewmats: Sequence[np.ndarray], points: np.ndarray, east_north_up: bool = False) -> None:
    """Writes a PNG: all from above, and from the side.

    Args:
        path: of the picture.
        viewmats: world to camera [4, 4] in the order of the recording.
        points: [P, 3].
        east_north_up: whether the world's axes are these, in metres; else the picture has those of the largest, second
            largest and least extent of points and cameras, in units of the reconstruction.
    """
    poses = np.stack(viewmats)
    centers = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    sights = poses[:, 2, :3]
    middle = np.median(points, axis=0)
    if east_north_up:
        axes, labels = np.eye(3), ("east, m", "north, m", "up, m")
    else:
        axes, labels = upright(points - middle, sights), ("units of the reconstruction",) * 3
    cloud, where, sights = ((xyz - at) @ axes.T for xyz, at in ((points, middle), (centers, middle), (sights, 0.0)))
    low, high = np.quantile(cloud, [(1 - SHOWN) / 2, (1 + SHOWN) / 2], axis=0)
    low, high = np.minimum(low, where.min(0)), np.maximum(high, where.max(0))
    length = SIGHT * float((high - low).max())
    kept = ((cloud >= low) & (cloud <= high)).all(1)
    wide, *others = high - low
    # The panels fill the picture, whatever the scene's shape.
    tall = float(np.clip(5.5 * max(others) / wide + 1.0, 3.5, 9.0))
    figure = Figure(figsize=(12, tall), layout="compressed")
    for panel, (across, up, title) in zip(
        figure.subplots(1, 2), ((0, 1, "from above"), (0, 2, "from the side")), strict=True
    ):
        size = float(np.clip(3000.0 / len(points), 1.5, 10.0))
        panel.scatter(cloud[kept, across], cloud[kept, up], s=size, color="0.6", linewidths=0)
        panel.plot(where[:, across], where[:, up], color="0.3", linewidth=0.6, alpha=0.6)
        panel.quiver(
            where[:, across], where[:, up], length * sights[:, across], length * sights[:, up],
            angles="xy", scale_units="xy", scale=1, width=0.003, headwidth=3, color="tab:red", alpha=0.7,
        )  # fmt: skip
        shown = panel.scatter(where[:, across], where[:, up], c=np.arange(len(where)), s=14, cmap="viridis", zorder=3)
        panel.set(title=title, xlabel=labels[across], ylabel=labels[up], aspect="equal")
    figure.colorbar(shown, ax=figure.axes, label="frame", shrink=0.8)
    figure.suptitle(f"{len(where)} cameras, their lines of sight, and {len(points)} points")
    save_picture(figure, path)


def upright(points: np.ndarray, sights: np.ndarray) -> np.ndarray:
    """Axes [3, 3] of the largest, second and least extent of points about their middle, the last against the sights."""
    near = points[np.argsort((points**2).sum(1))[: max(3, int(0.9 * len(points)))]]
    axes = np.linalg.svd(near, full_matrices=False)[2]
    if axes[2] @ sights.mean(0) > 0:
        axes[2] *= -1
    axes[0] = np.cross(axes[1], axes[2])
    return axes
