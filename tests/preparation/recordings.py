"""Small recordings on disk as cameras leave them."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import cv2
import numpy as np
from camera_files import camera_record, fff, flir_jpeg, gps_record, raw_for, temperatures

from heatsplat.preparation.frame import ThermalFrame
from heatsplat.preparation.frames import Reading, read_recording

START = datetime(2024, 7, 1, 12, 0, tzinfo=UTC)
STATED = {"emissivity": 0.95, "distance_m": 20.0, "reflected_k": 283.15, "air_k": 288.15, "humidity": 0.5}


def flir_frame(index: int, **options) -> bytes:
    """A JPEG of FLIR, one each two seconds, along a meridian."""
    camera = camera_record("<", STATED, START + timedelta(seconds=2 * index))
    gps = gps_record(51.0 + 1e-5 * index, 7.0, 100.0)
    return flir_jpeg(raw_for(temperatures(index)), camera=camera, gps=gps, **options)


def write_flir(folder: Path, count: int = 4, **options) -> Path:
    """A folder of JPEGs of FLIR, the names in another order than the times."""
    folder.mkdir(parents=True, exist_ok=True)
    for index in range(count):
        (folder / f"IR_{(7 * index) % count:04d}.jpg").write_bytes(flir_frame(index, **options))
    return folder


def write_sequence(path: Path, count: int = 4) -> Path:
    """A .seq recording."""
    path.parent.mkdir(parents=True, exist_ok=True)
    camera = [camera_record("<", STATED, START + timedelta(seconds=2 * index)) for index in range(count)]
    path.write_bytes(b"".join(fff(raw_for(temperatures(i)), camera=camera[i]) for i in range(count)))
    return path


def write_images(folder: Path, images: dict[str, np.ndarray]) -> Path:
    """A folder of images as they are."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, pixels in images.items():
        assert cv2.imwrite(str(folder / name), pixels)
    return folder


def read_frames(folder: Path, reading: Reading | None = None) -> list[ThermalFrame]:
    """The thermal frames of all files in a folder, without the notes on them."""
    return read_recording(folder, reading).frames
