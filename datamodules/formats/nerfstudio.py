"""Scenes as JSON with one camera-to-world matrix per frame: nerfstudio's transforms files and Blender-style ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.lens import MODELS, Lens, lens_of
from heatsplat.datamodules.poses import checked_pose
from heatsplat.datamodules.side_files import finite, json_object, shortened
from heatsplat.datamodules.timestamps import seconds_of
from heatsplat.geometry.transforms import OPENGL_AXES

# nerfstudio has one OPENCV model for all polynomial lenses; FULL_OPENCV reads whatever of its coefficients are there.
_COLMAP_NAME = {"OPENCV": "FULL_OPENCV", "PERSPECTIVE": "PINHOLE"}
# Models of one focal length, and what they are with two: files give fl_y beside them, and nerfstudio itself takes it.
_OF_TWO = {"SIMPLE_PINHOLE": "PINHOLE", "SIMPLE_RADIAL": "OPENCV", "RADIAL": "OPENCV",
           "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE", "RADIAL_FISHEYE": "OPENCV_FISHEYE"}  # fmt: skip
_COEFFICIENTS = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
_OTHER_POLYNOMIAL = ("k4", "k5", "k6")  # nerfstudio's k4 is that of r^8, which OpenCV does not have; OpenCV's divides
# Keys of a frame's images, in order of preference: the first of each is the data sets' own.
THERMAL_KEYS = ("thermal_file_path", "thermal", "thermal_path", "ir", "infrared")
VISIBLE_KEYS = ("file_path", "rgb", "rgb_file_path", "rgb_path", "image", "image_path", "color")

TIME_KEYS = ("time_s", "time")


@dataclass(frozen=True, eq=False)
class Transforms:
    """A transforms file, its frames as dictionaries.

    Args:
        path: the file.
        values: everything in it but the frames; keys here stand for all frames that do not have them.
        frames: one dictionary per frame with at least file_path and transform_matrix.
        assumed: other keys than those of nerfstudio that its image paths were found under, or nothing.
    """

    path: Path
    values: dict[str, Any]
    frames: list[dict[str, Any]]
    assumed: str = ""

    @property
    def applied_transform(self) -> np.ndarray:
        """What was done to COLMAP's world to get this one [4, 4]; the identity where the file does not say."""
        return checked_pose(self.values.get("applied_transform", np.eye(4)), f"{self.path}: applied_transform")


def read_transforms(path: Path, unnamed: str = "") -> Transforms:
    """A transforms file. Raises SceneError naming file and key when frames are missing or incomplete.

    Args:
        path: the file.
        unnamed: file_path of frames without one, with a place for their number, such as "camera_{:04d}.png"; empty refuses them.
    """
    values = json_object(path)
    frames = values.pop("frames", None)
    if not frames or not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise SceneError(f"{path} has no frames: key 'frames' is {shortened(frames)}, a list of {{...}} is needed")
    used: set[str] = set()
    for i, frame in enumerate(frames):
        thermal, visible = (_path_in(frame, keys, used) for keys in (THERMAL_KEYS, VISIBLE_KEYS))
        visible = visible or (None if thermal else unnamed.format(i))
        for key, there in (("file_path", thermal or visible), ("transform_matrix", "transform_matrix" in frame)):
            if not there:
                has = f"{shortened(frame[key])} under" if key in frame else "no key"
                raise SceneError(f"{path}: frame {i} has {has} {key!r}; it has {', '.join(frame)}")
        frame["file_path"] = visible or thermal
        if thermal:
            frame["thermal_file_path"] = thermal
    return Transforms(path, values, frames, assumed=", ".join(sorted(used - {THERMAL_KEYS[0], VISIBLE_KEYS[0]})))


def _path_in(frame: dict[str, Any], keys: Sequence[str], used: set[str]) -> str | None:
    """The path under the first of the keys that has one, itself or under a file_path of its own; the key is noted."""
    for key in keys:
        value = frame.get(key)
        if isinstance(value, dict):
            value = value.get("file_path")
        if isinstance(value, str) and value:
            used.add(key)
            return value.replace("\\", "/")  # as instant-ngp writes them on Windows
    return None


def viewmat_of(transforms: Transforms, frame: dict[str, Any], opengl: bool) -> np.ndarray:
    """World-to-camera [4, 4] float64 in OpenCV axes.

    Args:
        transforms: the file, for messages.
        frame: one of its frames; its transform_matrix is camera-to-world.
        opengl: True when camera axes are OpenGL's (x right, y up, z back), False when they are OpenCV's already.

    Raises:
        SceneError: the matrix is no pose; it is named with its file and frame (``poses.checked_pose``).
    """
    c2w = checked_pose(frame["transform_matrix"], f"{transforms.path}: transform_matrix of {frame['file_path']}")
    if opengl:
        c2w = c2w @ OPENGL_AXES
    return np.linalg.inv(c2w)


def time_in(transforms: Transforms, frame: dict[str, Any]) -> float | None:
    """Seconds of a frame, None where it has no time: a number, or an ISO 8601 date-time. Raises SceneError for anything else."""
    key = next((key for key in TIME_KEYS if frame.get(key) is not None), None)
    if key is None:
        return None
    source = f"{transforms.path}: {key} of {frame['file_path']}"
    if not isinstance(frame[key], str):
        return finite(frame[key], source)
    try:
        return finite(seconds_of(frame[key]), source)
    except ValueError as error:
        raise SceneError(
            f"{source} is {frame[key]!r}, neither seconds nor a date-time such as 2024-08-06T15:35:05.376"
        ) from error


def _focal(values: dict[str, Any], axis: str, pixels: int, source: str) -> float | None:
    """Focal length along "x" or "y" in pixels, of an image with so many of them there; None where nothing tells it."""
    if (key := f"fl_{axis}") in values:
        return finite(values[key], f"{source}: {key}")
    if (key := f"camera_angle_{axis}") not in values:
        return None
    angle = finite(values[key], f"{source}: {key}")
    if not 0 < angle < math.pi:
        raise SceneError(f"{source}: {key} is {angle:g}, the field of view in radians (0 to pi) is needed")
    return 0.5 * pixels / math.tan(0.5 * angle)


def lens_in(transforms: Transforms, frame: dict[str, Any], size: Callable[[], tuple[int, int]]) -> Lens:
    """The lens of a frame, from its own keys or those of the file.

    Args:
        transforms: the file.
        frame: one of its frames.
        size: returns (width, height) of the stored image, asked only where the file does not give w and h.

    Raises:
        SceneError: no focal length, a camera model that is not supported, or distortion that the model does not have.
    """
    source = f"{transforms.path}, {frame['file_path']}"
    values = {**transforms.values, **frame}
    for axis in "xy":  # a frame's own field of view goes before the file's focal length
        if f"camera_angle_{axis}" in frame and f"fl_{axis}" not in frame:
            values.pop(f"fl_{axis}", None)
    model = _model_of(values, source)
    width, height = _size_of(values, size, source)
    fx = _focal(values, "x", width, source)
    if fx is None:
        raise SceneError(f"{source}: no focal length; fl_x or camera_angle_x is needed")
    fy = _focal(values, "y", height, source)
    if fy is not None and fy != fx:
        model = _OF_TWO.get(model, model)
    known = {"f": fx, "fx": fx, "fy": fx if fy is None else fy}
    known |= {"cx": _number(values, "cx", source, width / 2), "cy": _number(values, "cy", source, height / 2)}
    params = [known[key] if key in known else _number(values, key, source) for key in MODELS[model].split()]
    return lens_of(model, params, width, height, source)


def _number(values: dict[str, Any], key: str, source: str, default: float = 0.0) -> float:
    return finite(values.get(key, default), f"{source}: {key}")


def _model_of(values: dict[str, Any], source: str) -> str:
    """COLMAP's name of a camera model. Raises SceneError for one that is not supported or lacks a coefficient that is given."""
    said = str(values.get("camera_model", "OPENCV_FISHEYE" if values.get("is_fisheye") else "OPENCV")).upper()
    model = _COLMAP_NAME.get(said, said)
    fisheye = "FISHEYE" in model
    if values.get("is_fisheye") and not fisheye:
        raise SceneError(f"{source}: is_fisheye is true, but camera_model is {said}; keep one of them")
    if model not in MODELS:
        lens_of(model, (), 0, 0, source)  # raises, naming the supported models
    has = set(MODELS[model].split()) - set(_OTHER_POLYNOMIAL if said == "OPENCV" else ())
    for key in _COEFFICIENTS:
        if key in has or not values.get(key) or not (given := _number(values, key, source)):
            continue
        meant = "OPENCV_FISHEYE" if fisheye else "FULL_OPENCV" if key in _OTHER_POLYNOMIAL else "OPENCV"
        instead = "" if meant == said else f"say camera_model {meant} if it is one of that, or "
        raise SceneError(
            f"{source}: {key} is {given:g}, and camera model {said} has no {key}; {instead}undistort the images and take "
            f"{key} out"
        )
    return model


def _size_of(values: dict[str, Any], size: Callable[[], tuple[int, int]], source: str) -> tuple[int, int]:
    """Width and height of the images that the numbers are for. Raises SceneError where the stored one cannot be meant."""
    if "w" in values and "h" in values:
        return int(_number(values, "w", source)), int(_number(values, "h", source))
    width, height = size()
    cx, cy = _number(values, "cx", source), _number(values, "cy", source)
    if not (0 <= cx <= width and 0 <= cy <= height):
        raise SceneError(
            f"{source}: the principal point {cx:g}, {cy:g} lies outside its image of {width}x{height}, and w and h are missing: "
            "give those of the images that focal length and principal point are for"
        )
    return width, height
