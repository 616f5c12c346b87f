"""A recording as a camera left it: its frames with what their files say of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.images import list_images, read_image
from heatsplat.datamodules.formats.radiometric import has_temperatures, read_celsius


@dataclass(frozen=True)
class CameraInfo:
    """Which camera took a frame; None where the file does not say."""

    make: str | None = None
    model: str | None = None
    serial: str | None = None
    focal_mm: float | None = None
    field_of_view_deg: float | None = None
    frame_rate_hz: float | None = None


@dataclass(frozen=True)
class Position:
    """Where a frame was taken, by GPS: WGS 84 in degrees, metres, and the standard deviations that the file states."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float | None = None
    above_takeoff_m: float | None = None
    horizontal_sd_m: float | None = None
    vertical_sd_m: float | None = None


@dataclass(frozen=True)
class Attitude:
    """Where the camera looked, in degrees: yaw clockwise from north, pitch -90 straight down, roll."""

    yaw_deg: float
    pitch_deg: float
    roll_deg: float


@dataclass(frozen=True)
class Frame:
    """One thermal frame of a recording.

    Args:
        name: of its image in a prepared folder, without an ending; unique among the frames.
        path: file it stands in.
        number: which frame of that file, from 0.
        load: returns the temperatures [H, W] float32 in °C, NaN where unknown.
        time: when it was taken; without a zone where the file has none, None where it has no time.
        camera, position, attitude: what the file says of them.
        rgb: photo that belongs to it, or None.
    """

    name: str
    path: Path
    number: int
    load: Callable[[], np.ndarray] = field(repr=False)
    time: datetime | None = None
    camera: CameraInfo = CameraInfo()
    position: Position | None = None
    attitude: Attitude | None = None
    rgb: Path | None = None

    def temperature(self) -> np.ndarray:
        """Temperatures [H, W] float32 in °C, NaN where unknown. Raises SceneError when the file cannot be read."""
        return self.load()


def read_frames(folder: Path) -> list[Frame]:
    """The thermal frames of all files in a folder, in the order of their times, else of their names.

    Raises:
        SceneError: the folder holds none, or a file that cannot be read.
    """
    if not folder.is_dir():
        raise SceneError(f"source={folder} is no folder")
    frames = [
        Frame(name=Path(name).with_suffix("").as_posix().replace("/", "_"), path=folder / name, number=0, load=load)
        for name in list_images(folder)
        if (load := _loader(folder / name)) is not None
    ]
    if not frames:
        raise SceneError(f"source={folder} holds no thermal frame")
    return frames


def _loader(path: Path) -> Callable[[], np.ndarray] | None:
    if path.suffix.lower() in (".jpg", ".jpeg"):
        return (lambda: read_celsius(path)) if has_temperatures(path) else None
    return lambda: read_image(path)
