"""Small scenes on disk in the layouts of the data sets, for the loaders' tests."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import cv2  # first, before anything brings pycolmap
import numpy as np

from heatsplat.datamodules.formats.colmap import write_model

WIDTH, HEIGHT = 40, 32
FOCAL = 38.0
PINHOLE = ("PINHOLE", (FOCAL, FOCAL + 2.0, 20.5, 15.0), WIDTH, HEIGHT)
BOUNDS = {"absolute_min_temperature": 10.0, "absolute_max_temperature": 40.0}


def viewmats(count: int, center: Sequence[float] = (0.0, 0.0, 0.0)) -> list[np.ndarray]:
    """World-to-camera matrices of cameras on a half circle of radius 4 about ``center``, looking at it."""
    result = []
    for i in range(count):
        angle = np.pi * i / max(1, count - 1)
        eye = np.array([4 * np.cos(angle), 4 * np.sin(angle), 1.0])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ (eye + np.asarray(center))
        result.append(viewmat)
    return result


def points(count: int = 30, center: Sequence[float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    """Points in the unit cube about ``center``, [count, 3]."""
    return np.random.default_rng(1).uniform(-0.5, 0.5, (count, 3)) + np.asarray(center)


def grey(index: int, dtype: type = np.uint8, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """A grey image that differs from frame to frame and over the pixels."""
    y, x = np.mgrid[:height, :width]
    full = np.iinfo(dtype).max
    return ((x * 3 + y * 2 + index * 5) * (full // 255) % full).astype(dtype)


def write_image(path: Path, pixels: np.ndarray) -> None:
    """Writes grey or RGB(A) pixels as they are."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if pixels.ndim == 3:
        pixels = pixels[..., [2, 1, 0, 3][: pixels.shape[2]]]
    assert cv2.imwrite(str(path), pixels)


def write_colmap(
    scene: Path,
    names: Sequence[str],
    *,
    camera: tuple = PINHOLE,
    place: str = "sparse/0",
    images: str | None = "images",
    pixels: Sequence[np.ndarray] | None = None,
    text: bool = False,
    point_count: int = 30,
    center: Sequence[float] = (0.0, 0.0, 0.0),
) -> Path:
    """images/ and sparse/0 with one camera; returns the scene folder."""
    xyz = points(point_count, center)
    write_model(
        scene / place,
        dict(zip(names, viewmats(len(names), center), strict=True)),
        [camera],
        xyz,
        np.full((len(xyz), 3), 128),
        text=text,
    )
    if images:
        for i, name in enumerate(names):
            write_image(scene / images / name, grey(i) if pixels is None else pixels[i])
    return scene


def write_json(path: Path, values: object) -> None:
    """Writes JSON, making folders."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values))


def names(count: int, form: str = "frame_{:03d}.png") -> list[str]:
    """File names of ``count`` frames."""
    return [form.format(i) for i in range(count)]


def rhd_names(seconds: Sequence[float]) -> list[str]:
    """RHD's names HHMMSSmmm.png of times of day."""
    result = []
    for s in seconds:
        whole, thousandths = divmod(round(s * 1000), 1000)
        result.append(f"{whole // 3600 % 24:02d}{whole // 60 % 60:02d}{whole % 60:02d}{thousandths:03d}.png")
    return result


def write_rhd(root: Path, scene: str, files: Sequence[str], info: dict | None = None, **colmap: object) -> Path:
    """root/scene/thermal in RHD's layout; returns root."""
    folder = root / scene / "thermal"
    write_colmap(folder, files, **colmap)  # type: ignore[arg-type]
    if info is not None:
        write_json(folder / "info.json", info)
    return root


def opengl(viewmat: np.ndarray) -> list[list[float]]:
    """Camera-to-world matrix in OpenGL axes of a world-to-camera matrix in OpenCV axes."""
    return (np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()


def write_thermoscenes(
    scene: Path,
    stems: Sequence[str],
    *,
    bounds: dict | None = BOUNDS,
    distortion: dict | None = None,
    file: str = "transforms_thermal.json",
    turn: np.ndarray | None = None,
    extra: dict | None = None,
) -> Path:
    """A scene in ThermoScenes' layout; ``turn`` [4, 4] is applied to the world as nerfstudio's applied_transform."""
    turn = np.eye(4) if turn is None else turn
    frames = []
    for i, (stem, viewmat) in enumerate(zip(stems, viewmats(len(stems)), strict=True)):
        write_image(scene / "thermal" / f"{stem}.PNG", grey(i))
        write_image(scene / "images" / f"{stem}.JPG", np.repeat(grey(i)[..., None], 3, axis=2))
        pose = turn @ np.array(opengl(viewmat))
        frames.append(
            {
                "file_path": f"images/{stem}.JPG",
                "thermal_file_path": f"thermal/{stem}.PNG",
                "transform_matrix": pose.tolist(),
            }
        )
    write_json(
        scene / file,
        {
            "w": WIDTH,
            "h": HEIGHT,
            "fl_x": FOCAL,
            "fl_y": FOCAL + 2.0,
            "cx": 20.5,
            "cy": 15.0,
            "camera_model": "OPENCV",
            "applied_transform": turn[:3].tolist(),
            "frames": frames,
            **(distortion or {}),
            **(extra or {}),
        },
    )
    if bounds is not None:
        write_json(scene / "temperature_bounds.json", bounds)
    return scene
