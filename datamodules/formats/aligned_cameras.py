"""Cameras as another program has aligned them: what there is of them, and where they stand on the earth."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.poses import checked_pose

NO_SKEW_PX = 0.25  # by what an affine skew may move a pixel; cameras are hardly known that well
WGS_84_M = 6_378_137.0  # half the longer axis of its ellipsoid, and of GRS 80, which ETRS89 has


@dataclass(frozen=True)
class AlignedCameras:
    """Cameras as another tool wrote them.

    Args:
        source: file or folder that they stand in.
        cameras: name of an image -> world-to-camera [4, 4] in OpenCV axes, and lens.
        points, colors: [P, 3], colors in [0, 1]; none of them where the tool wrote none.
        left_out: name of an image without a camera -> why it has none.
        refused: name of an image whose camera no lens here is -> what to do about it.
        notes: sentences on what was assumed.
        metres_per_unit: of the world, or None.
        east_north_up: whether these are the axes of the world.
        origin: [3] latitude and longitude in degrees (WGS 84) and height in metres of the world's zero, or None.
    """

    source: Path
    cameras: Mapping[str, tuple[np.ndarray, Lens]]
    points: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    left_out: Mapping[str, str] = field(default_factory=dict)
    refused: Mapping[str, str] = field(default_factory=dict)
    notes: Sequence[str] = ()
    metres_per_unit: float | None = None
    east_north_up: bool = False
    origin: np.ndarray | None = None


def world_to_camera(rotation: np.ndarray, center: np.ndarray, where: str) -> np.ndarray:
    """World-to-camera [4, 4] of a camera-to-world rotation [3, 3] and its place [3].

    Raises:
        SceneError: it is no pose (``poses.checked_pose``); ``where`` is named.
    """
    pose = checked_pose(np.column_stack([rotation, center]), where)
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
    return viewmat


def checked_skew(skew: float, focal_px: float, cy: float, height: int, key: str, remedy: str) -> list[str]:
    """A note on a skew that is left out, none for 0: no lens here has one.

    Args:
        skew: pixels to the right for each unit of y / z.
        focal_px, cy, height: focal length, principal point and size of the image along y, in pixels.
        key: which number of which file it is, for the message.
        remedy: what helps.

    Raises:
        SceneError: it moves pixels by more than ``NO_SKEW_PX``.
    """
    moved = abs(skew) * max(cy, height - cy) / focal_px
    if moved > NO_SKEW_PX:
        raise SceneError(
            f"{key} is {skew:g}, a skew that moves pixels by up to {moved:.2f} and that lenses here do not have; {remedy}"
        )
    return [f"{key} is {skew:g}, a skew that is left out: it moves pixels by at most {moved:.2f}."] if skew else []


def numbers_in(text: str | None, count: int, where: str, remedy: str) -> np.ndarray:
    """Numbers [count] between blanks. Raises SceneError, naming ``where``, for anything else."""
    words = (text or "").split()
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        raise SceneError(f"{where}: {error}; {remedy}") from error
    if len(numbers) != count or not np.isfinite(numbers).all():
        found = f"{len(numbers)}" if len(numbers) != count else "some that are not finite"
        raise SceneError(f"{where}: {count} numbers are needed, it has {found}; {remedy}")
    return numbers
