"""Cameras that a file lists, from which a scene is looked at: a transforms.json, or a COLMAP model. They need no images."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any

import torch

from heatsplat.contracts import Camera, Frame, SceneData, SceneError
from heatsplat.datamodules.formats.colmap import find_model, is_model, read_model_of
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.formats.nerfstudio import lens_in, read_transforms, time_in, viewmat_of
from heatsplat.datamodules.side_files import json_object
from heatsplat.datamodules.weather_table import FIRST_EPOCH_S

log = logging.getLogger(__name__)


class ListedCameras:
    """The cameras of files and folders, in their order.

    Args:
        path: one or a list of transforms.json and folders with a COLMAP model, in the world of the data set; None lists none. A
            transforms.json has camera-to-world matrices in OpenGL axes, w, h and fl_x or camera_angle_x, and where a camera has a
            time time_s in seconds since the first training frame, or a date-time; names (file_path) may be left out.

    Attributes:
        frames: in the world of the data set; ``frame_id`` is their number, which also stands in names that several have. Times
            are seconds since the first training frame, or from 1e8 on since 1970; None where a camera has none.

    Raises:
        SceneError: there are none, or one is no camera. File and key are named.
    """

    def __init__(self, path: str | Path | Sequence[str | Path] | None = None) -> None:
        self.frames: list[Frame] = []
        for one in [path] if isinstance(path, str | Path) else path or ():
            source = Path(one).expanduser()
            found = _of_model(source) if source.is_dir() else _of_transforms(source)
            if any(lens.is_distorted for _, _, lens, _ in found):
                log.warning("camera_file=%s: lenses distort; images are rendered as by lenses that do not", one)
            for name, pose, lens, time_s in found:
                camera = Camera(torch.as_tensor(pose), torch.from_numpy(lens.matrix()), lens.width, lens.height)
                self.frames.append(Frame(name, len(self.frames), camera, time_s))
        alike = Counter(frame.name for frame in self.frames)
        self.frames = [_numbered(frame) if alike[frame.name] > 1 else frame for frame in self.frames]

    def in_scene(self, scene: SceneData) -> list[Frame]:
        """The frames in the world and on the clock of a scene that was loaded of the data set.

        Raises:
            SceneError: a camera has a date, and nothing tells the clock of the scene.
        """
        return [
            replace(one, camera=_about(one.camera, scene.origin), time_s=_seconds(one, scene.clock_at_zero_s))
            for one in self.frames
        ]


def _of_transforms(path: Path) -> list[tuple[str, Any, Lens, float | None]]:
    if not path.is_file():
        raise SceneError(
            f"camera_file={path}: there is no such file or folder; give a transforms.json or a COLMAP model"
        )
    if "camera_path" in json_object(path):
        raise SceneError(
            f"camera_file={path} is a camera path of nerfstudio's viewer, in a world that nerfstudio has turned and scaled; "
            "give a transforms.json in the world of the data, as viewer.html saves"
        )
    transforms = read_transforms(path, unnamed="camera_{:04d}.png")

    def size() -> tuple[int, int]:
        raise SceneError(f"camera_file={path} lacks w and h, the size of the images in pixels")

    return [
        (
            str(frame["file_path"]),
            viewmat_of(transforms, frame, opengl=True),
            lens_in(transforms, frame, size),
            time_in(transforms, frame),
        )
        for frame in transforms.frames
    ]


def _of_model(folder: Path) -> list[tuple[str, Any, Lens, float | None]]:
    found = folder if is_model(folder) else find_model(folder)
    if found is None:
        raise SceneError(f"camera_file={folder} holds no COLMAP model; give its folder, or a transforms.json itself")
    model = read_model_of(found)
    return [(*one, None) for one in zip(model.names, model.viewmats, model.lenses, strict=True)]


def _numbered(frame: Frame) -> Frame:
    path = PurePosixPath(frame.name)
    return replace(frame, name=str(path.with_stem(f"{path.stem}_{frame.frame_id:04d}")))


def _about(camera: Camera, origin: torch.Tensor) -> Camera:
    viewmat = camera.viewmat.clone()
    viewmat[:3, 3] += viewmat[:3, :3] @ origin
    return replace(camera, viewmat=viewmat)


def _seconds(camera: Frame, clock_at_zero_s: float | None) -> float | None:
    if camera.time_s is None or camera.time_s < FIRST_EPOCH_S:
        return camera.time_s
    if clock_at_zero_s is None:
        raise SceneError(
            f"camera {camera.name} has a date, and nothing tells the clock of the scene; give time_s in seconds since the first "
            "training frame"
        )
    return camera.time_s - clock_at_zero_s
