"""Scenes as JSON with one camera-to-world matrix per frame: nerfstudio's transforms files and Blender-style ones."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from heatsplat.datamodules.bounds import read_json
from heatsplat.datamodules.formats.lens import MODELS, Lens, lens_of

from heatsplat.contracts import SceneError

# nerfstudio has one OPENCV model for all polynomial lenses; FULL_OPENCV reads whatever of its coefficients are there.
_COLMAP_NAME = {"OPENCV": "FULL_OPENCV", "PERSPECTIVE": "PINHOLE"}


@dataclass(frozen=True)
class Transforms:
    """A transforms file, its frames as dictionaries.

    Args:
        path: the file.
        values: everything in it but the frames; keys here stand for all frames that do not have them.
        frames: one dictionary per frame with at least file_path and transform_matrix.
    """

    path: Path
    values: dict[str, Any]
    frames: list[dict[str, Any]]

    @property
    def applied_transform(self) -> np.ndarray:
        """What was done to COLMAP's world to get this one [4, 4]; the identity where the file does not say."""
        matrix = np.eye(4)
        given = np.array(self.values.get("applied_transform", matrix[:3]), dtype=np.float64)
        if given.shape not in ((3, 4), (4, 4)):
            raise SceneError(f"{self.path}: applied_transform must be 3x4 or 4x4, got {given.shape}")
        matrix[:3] = given[:3]
        return matrix


def read_transforms(path: Path) -> Transforms:
    """A transforms file. Raises SceneError naming file and key when frames are missing or incomplete."""
    values = read_json(path)
    if not isinstance(values, dict) or not values.get("frames"):
        raise SceneError(f"{path} has no frames (key 'frames')")
    frames = values.pop("frames")
    for i, frame in enumerate(frames):
        for key in ("file_path", "transform_matrix"):
            if key not in frame:
                raise SceneError(f"{path}: frame {i} has no key {key!r}; it has {', '.join(frame)}")
    return Transforms(path, values, frames)


def viewmat_of(transforms: Transforms, frame: dict[str, Any], opengl: bool) -> np.ndarray:
    """World-to-camera [4, 4] float64 in OpenCV axes.

    Args:
        transforms: the file, for messages.
        frame: one of its frames; its transform_matrix is camera-to-world.
        opengl: True when camera axes are OpenGL's (x right, y up, z back), False when they are OpenCV's already.

    Raises:
        SceneError: the matrix is not 4x4, not finite or singular.
    """
    c2w = np.array(frame["transform_matrix"], dtype=np.float64)
    if c2w.shape == (3, 4):
        c2w = np.vstack([c2w, [0.0, 0.0, 0.0, 1.0]])
    if c2w.shape != (4, 4) or not np.isfinite(c2w).all() or abs(np.linalg.det(c2w[:3, :3])) < 1e-6:
        raise SceneError(
            f"{transforms.path}: transform_matrix of {frame['file_path']} is no camera pose (4x4, invertible)"
        )
    if opengl:
        c2w = c2w @ np.diag([1.0, -1.0, -1.0, 1.0])
    return np.linalg.inv(c2w)


def lens_in(transforms: Transforms, frame: dict[str, Any], size: Callable[[], tuple[int, int]]) -> Lens:
    """The lens of a frame, from its own keys or those of the file.

    Args:
        transforms: the file.
        frame: one of its frames.
        size: returns (width, height) of the stored image, asked only where the file does not give w and h.

    Raises:
        SceneError: no focal length, or a camera model that is not supported.
    """
    values = {**transforms.values, **frame}
    model = str(values.get("camera_model", "OPENCV")).upper()
    model = _COLMAP_NAME.get(model, model)
    source = f"{transforms.path}, {frame['file_path']}"
    if model not in MODELS:
        lens_of(model, (), 0, 0, source)  # raises, naming the supported models
    width, height = (int(values["w"]), int(values["h"])) if "w" in values and "h" in values else size()
    if "fl_x" in values:
        fx = float(values["fl_x"])
    elif "camera_angle_x" in values:
        fx = 0.5 * width / math.tan(0.5 * float(values["camera_angle_x"]))
    else:
        raise SceneError(f"{source}: no focal length; fl_x or camera_angle_x is needed")
    fy = float(values.get("fl_y", fx))
    known = {"f": fx, "fx": fx, "fy": fy, "cx": values.get("cx", width / 2), "cy": values.get("cy", height / 2)}
    params = [float(known.get(key, values.get(key, 0.0))) for key in MODELS[model].split()]
    return lens_of(model, params, width, height, source)
