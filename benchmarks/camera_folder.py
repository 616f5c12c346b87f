"""Writes a recording as a camera leaves it: counts and photos with EXIF, no poses, and what goes wrong in the field."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import ExifTags, Image
from torch import Tensor

from heatsplat.datamodules.formats.geodesy import latitude_longitude
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.synthetic_scene.film import (
    Recording,
    Size,
    expose,
    film,
    own_threads,
    pixel_centres,
    pixel_rays,
)
from heatsplat.datamodules.synthetic_scene.outdoor import OUTDOOR, OutdoorScene
from heatsplat.geometry.projection import look_at
from heatsplat.physics.units import KELVIN_AT_0_C
from heatsplat.training.rng import generator_for

# Counts of 1/100 K, as Lepton and Boson cameras write them.
COUNTS_PER_KELVIN = 100.0
PIXEL_MM = 0.012  # pitch of the detector


@dataclass(frozen=True)
class Field:
    """What a camera meets in the field, and what its files say.

    Args:
        origin: latitude, longitude and altitude of the world's origin, whose axes are east, north and up; None: no GPS.
        gps_sd_m: standard deviation of a GPS position in each direction.
        start: when the record started.
        drift_k: what the level rises by from frame to frame, until the shutter closes.
        frames_per_shutter: frames between two shutters.
        dead_pixels: number of pixels that always show the same.
        model: of the thermal camera.
        rgb: whether a second, visible camera records beside.
        rgb_offset_m: where the visible camera stands, in the axes of the thermal one (right, down, forward).
        rgb_turn_deg: by how much it is turned against it, about the same axes.
        rgb_clock_s: by how much its clock is ahead.
    """

    origin: tuple[float, float, float] | None = None
    gps_sd_m: float = 0.0
    start: datetime = datetime(2024, 7, 11, tzinfo=UTC)
    drift_k: float = 0.0
    frames_per_shutter: int = 12
    dead_pixels: int = 0
    model: str = "Thermal 12"
    rgb: bool = False
    rgb_offset_m: tuple[float, float, float] = (-0.03, 0.01, 0.0)
    rgb_turn_deg: tuple[float, float, float] = (0.4, -0.7, 0.3)
    rgb_clock_s: float = 0.0


def write_camera(recording: Recording, folder: Path, field: Field = Field(), seed: int = 0) -> None:  # noqa: B008
    """A folder ``thermal`` of 16-bit TIFF (1/100 K), and ``rgb`` of JPEG where there is a visible camera.

    EXIF of each has its time with zone, camera, focal length, and where there is GPS its position. Names end with _T
    and _V.
    """
    count, height, width = recording.celsius.shape
    celsius = recording.celsius.astype(np.float64) + sawtooth(count, field)[:, None, None]
    stuck = dead_pixels(height, width, field.dead_pixels, seed)
    celsius[:, stuck[:, 0], stuck[:, 1]] = celsius.max() + 3.0
    positions = _gps(recording, field, seed)
    focal_mm = recording.lens.fx * PIXEL_MM
    for frame, time_s in enumerate(recording.times_s):
        counts = np.rint((celsius[frame] + KELVIN_AT_0_C) * COUNTS_PER_KELVIN).astype(np.uint16)
        when = field.start + timedelta(seconds=float(time_s))
        about = _exif(when, field.model, focal_mm, None if positions is None else positions[frame])
        _saved(Image.fromarray(counts), folder / "thermal" / f"frame_{frame:04d}_T.tiff", exif=about)
    if not field.rgb:
        return
    lens, rig = rgb_lens(recording.lens), rgb_from_thermal(field)
    rays = pixel_rays(lens, pixel_centres(lens))
    with own_threads():
        for frame, time_s in enumerate(recording.times_s):
            _, color = expose(
                recording.scene, lens, rays, rig @ torch.from_numpy(recording.viewmats[frame]), float(time_s)
            )
            when = field.start + timedelta(seconds=float(time_s) + field.rgb_clock_s)
            about = _exif(when, "Visible", lens.fx * PIXEL_MM, None if positions is None else positions[frame])
            pixels = (color.clamp(0, 1) * 255.0).round().to(torch.uint8).numpy()
            _saved(Image.fromarray(pixels), folder / "rgb" / f"frame_{frame:04d}_V.jpg", exif=about, quality=95)


def sawtooth(frames: int, field: Field) -> np.ndarray:
    """By how much each of the frames is too warm, in kelvin [F], with mean 0."""
    drift = field.drift_k * (np.arange(frames) % field.frames_per_shutter)
    return drift - drift.mean()


def dead_pixels(height: int, width: int, count: int, seed: int) -> np.ndarray:
    """Rows and columns [count, 2] of the pixels that are dead; some have a dead neighbour."""
    chosen = torch.randperm(height * width, generator=generator_for(seed, 0, "dead pixels"))[:count].numpy()
    return np.stack([chosen // width, chosen % width], axis=1)


def rgb_lens(lens: Lens) -> Lens:
    """The visible camera's lens: 1.5 times as many pixels, and a little wider."""
    scaled = replace(lens, distortion=(), model="PINHOLE").resized(lens.width * 3 // 2, lens.height * 3 // 2)
    return replace(scaled, fx=scaled.fx * 0.9, fy=scaled.fy * 0.9)


def rgb_from_thermal(field: Field) -> Tensor:
    """[4, 4]: camera axes of the visible camera from those of the thermal one."""
    x, y, z = torch.deg2rad(torch.tensor(field.rgb_turn_deg, dtype=torch.float64))
    spin = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.linalg.matrix_exp(spin)
    pose[:3, 3] = -pose[:3, :3] @ torch.tensor(field.rgb_offset_m, dtype=torch.float64)
    return pose


def flight(
    size: Size, hour: float = 14.0, duration_s: float = 240.0, seed: int = 0, **camera: float | Sequence[float]
) -> Recording:
    """The synthetic yard as a drone films it in one go: once and a half around it, from two heights.

    Args:
        size: images, frames and points.
        hour: of the first day, at which it starts (UTC).
        duration_s: length of the flight.
        seed: of the noise.
        **camera: of ``film``: noise_k, distortion.
    """
    world = OutdoorScene(OUTDOOR["outdoor"])
    world.route = partial(_around, 3600.0 * hour, duration_s)
    return film(world, size, seed, **camera)


def _around(start_s: float, duration_s: float, frames: int, seed: int) -> tuple[np.ndarray, Tensor]:
    share = torch.linspace(0.0, 1.0, frames, dtype=torch.float64)
    azimuth, elevation = 3.0 * torch.pi * share, torch.deg2rad(42.0 - 10.0 * torch.cos(2.0 * torch.pi * share))
    flat = 24.0 * torch.cos(elevation)
    aim = torch.tensor([0.0, -1.5, 1.5], dtype=torch.float64)
    eyes = aim + torch.stack([flat * azimuth.sin(), -flat * azimuth.cos(), 24.0 * elevation.sin()], dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return np.round(start_s + share.numpy() * duration_s, 3), torch.stack([look_at(eye, aim, up) for eye in eyes])


def _gps(recording: Recording, field: Field, seed: int) -> np.ndarray | None:
    """Latitude, longitude and altitude [F, 3] as a receiver tells them."""
    if field.origin is None:
        return None
    centers = np.linalg.inv(recording.viewmats)[:, :3, 3]
    noise = torch.randn(len(centers), 3, generator=generator_for(seed, 0, "gps"), dtype=torch.float64).numpy()
    return latitude_longitude(centers + field.gps_sd_m * noise, np.array(field.origin))


def _exif(when: datetime, model: str, focal_mm: float, position: np.ndarray | None) -> Image.Exif:
    exif = Image.Exif()
    exif[ExifTags.Base.Make], exif[ExifTags.Base.Model] = "Synthetic", model
    about = exif.get_ifd(ExifTags.IFD.Exif)
    about[ExifTags.Base.DateTimeOriginal] = f"{when:%Y:%m:%d %H:%M:%S}"
    about[ExifTags.Base.SubsecTimeOriginal] = f"{when.microsecond // 1000:03d}"
    about[ExifTags.Base.OffsetTimeOriginal] = "+00:00"
    about[ExifTags.Base.FocalLength] = focal_mm
    if position is not None:
        gps = exif.get_ifd(ExifTags.IFD.GPSInfo)
        latitude, longitude, altitude = map(float, position)
        gps[ExifTags.GPS.GPSLatitudeRef] = "N" if latitude >= 0 else "S"
        gps[ExifTags.GPS.GPSLatitude] = _degrees(latitude)
        gps[ExifTags.GPS.GPSLongitudeRef] = "E" if longitude >= 0 else "W"
        gps[ExifTags.GPS.GPSLongitude] = _degrees(longitude)
        gps[ExifTags.GPS.GPSAltitudeRef] = b"\0"
        gps[ExifTags.GPS.GPSAltitude] = altitude
        exif[ExifTags.IFD.GPSInfo] = dict(gps)  # what a TIFF is written from
    exif[ExifTags.IFD.Exif] = dict(about)
    return exif


def _degrees(angle: float) -> tuple[float, float, float]:
    minutes, seconds = divmod(abs(angle) * 3600.0, 60.0)
    degrees, minutes = divmod(minutes, 60.0)
    return degrees, minutes, seconds


def _saved(image: Image.Image, path: Path, **options: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    image.save(path, **options)
