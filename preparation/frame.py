"""One thermal frame of a recording, with what its file says of it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

import numpy as np

from heatsplat.contracts import SceneError, ThermalRange
from heatsplat.datamodules.formats.radiometric import CELSIUS, Calibration, surface_celsius
from heatsplat.physics.radiometry import Conditions


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
class ThermalFrame:
    """One thermal frame.

    Args:
        name: of its image in a prepared folder, without an ending; unique among the frames.
        path: file it stands in.
        number: which frame of that file, from 0.
        load: returns the stored pixels [H, W]: uint8, uint16 or float32.
        calibration: what these numbers mean; None for greys, which are no temperatures.
        conditions: what stands between camera and surface.
        sources: where each of the conditions comes from: "file", "given", or nothing for those that change nothing.
        time: when it was taken; without a zone where the file has none, None where it has no time.
        camera, position, attitude: what the file says of them.
        size: width and height of its pixels; None where only they tell.
        rgb: photo that belongs to it, or None.
        picture: returns the bytes of the photo inside the file, or None where it has none.
        span: °C of black and white of this frame alone, of greys and pictures in colours; None where they have none of their own.
    """

    name: str
    path: Path
    number: int
    load: Callable[[], np.ndarray] = field(repr=False)
    calibration: Calibration | None = CELSIUS
    conditions: Conditions = Conditions()
    sources: Mapping[str, str] = field(default_factory=dict)
    time: datetime | None = None
    camera: CameraInfo = CameraInfo()
    position: Position | None = None
    attitude: Attitude | None = None
    size: tuple[int, int] | None = None
    rgb: Path | None = None
    picture: Callable[[], bytes] | None = field(default=None, repr=False)
    span: ThermalRange | None = field(default=None, repr=False)

    def temperature(self) -> np.ndarray:
        """Temperatures [H, W] float32 in °C of the surfaces, NaN where unknown.

        Raises:
            SceneError: the file cannot be read, or holds no temperatures.
        """
        if self.calibration is None:
            raise SceneError(
                f"{self.path} holds greys without a meaning in °C; give bounds_c=[min,max], or spans in table="
            )
        return surface_celsius(self.load(), self.calibration, self.conditions)

    def pixels(self) -> np.ndarray:
        """Temperatures, or greys where there are none, [H, W] float32: what can be matched and looked at."""
        return self.load().astype(np.float32) if self.calibration is None else self.temperature()


@dataclass(frozen=True)
class ColouredFrame(ThermalFrame):
    """A frame whose numbers a palette told from colours: levels from 0 to 255, NaN where it told none.

    Args:
        palette: its colours and levels; another one makes other temperatures of the same file.
    """

    palette: tuple[float, ...] = ()


def frame_name(path: Path, folder: Path, number: int | None = None) -> str:
    """Name of a frame by its path below the folder of the recording, and by its number where the file holds several.

    It is text: of a path that is not UTF-8, as archives of older systems leave them, by Windows' own encoding.
    """
    stem = path.relative_to(folder).with_suffix("").as_posix().replace("/", "_")
    try:
        stem.encode()
    except UnicodeEncodeError:
        stem = os.fsencode(stem).decode("cp1252", "replace")
    return stem if number is None else f"{stem}_{number:06d}"
