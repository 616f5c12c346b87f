"""Radiometric files of makers as frames, and what the EXIF of any picture says."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import numpy as np

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats import dji, flir
from heatsplat.datamodules.formats.exif import exif_in
from heatsplat.datamodules.formats.images import read_bytes
from heatsplat.datamodules.formats.radiometric import Calibration
from heatsplat.physics.radiometry import Conditions, PlanckResponse
from heatsplat.physics.units import KELVIN_AT_0_C
from heatsplat.preparation.frame import Attitude, CameraInfo, Position, ThermalFrame, frame_name
from heatsplat.preparation.meaning import Meaning

log = logging.getLogger(__name__)

SEQUENCES = (".seq", ".csq")
RECORDS = (".fff", *SEQUENCES)


def radiometric_frames(path: Path, folder: Path, meaning: Meaning, notes: list[str]) -> Iterator[ThermalFrame]:
    """The frames of a radiometric file of FLIR or DJI. Raises SceneError where it is none, or cannot be understood."""
    if path.suffix.lower() in SEQUENCES:
        places = flir.frames_in(path)
        if cut := path.stat().st_size - sum(places[-1]):
            notes.append(
                f"{path.name}: {cut} bytes after its last whole frame are left out; was the recording cut short?"
            )
        for number, (start, length) in enumerate(places):
            record = flir.Record(flir.read_part(path, start, length), f"{path}, frame {number}")
            read = partial(flir.read_part, path, start, length)
            yield _of_flir(record, path, frame_name(path, folder, number), number, read, planck=meaning.planck)
        return
    data = read_bytes(path)
    if payload := flir.payload_of(data):
        record = flir.Record(payload, str(path))
        read = partial(_payload, path)
        yield _of_flir(record, path, frame_name(path, folder), 0, read, data, planck=meaning.planck)
    elif dji.array_of(data) is not None:
        yield _of_dji(path, frame_name(path, folder), data, meaning)
    else:
        raise SceneError(f"{path} is no FLIR file; copy it again or remove it")


def _payload(path: Path) -> bytes:
    return flir.payload_of(read_bytes(path))


def _of_flir(
    record: flir.Record,
    path: Path,
    name: str,
    number: int,
    read: Callable[[], bytes],
    data: bytes = b"",
    planck: Sequence[float] | None = None,
) -> ThermalFrame:
    """The frame of an FFF record, by the camera's own constants unless others are given.

    It is read anew for its pixels, so that a recording need not fit into memory.
    """
    found = record.measured()
    response = found.response if planck is None else PlanckResponse(*(float(x) for x in planck))
    details, camera = exif_details(data)
    if found.time is not None:
        details["time"] = found.time
    if found.latitude_deg is not None and "position" not in details:
        details["position"] = Position(found.latitude_deg, found.longitude_deg, found.altitude_m)

    def again() -> flir.Record:
        return flir.Record(read(), record.name)

    return ThermalFrame(
        name,
        path,
        number,
        load=lambda: again().counts(),
        calibration=Calibration(response),
        conditions=found.conditions,
        sources=dict.fromkeys(found.given, "file"),
        camera=CameraInfo(
            camera.make or "FLIR",
            found.model,
            found.serial,
            camera.focal_mm,
            found.field_of_view_deg,
            found.frame_rate_hz,
        ),
        size=record.size(),
        picture=(lambda: again().picture() or b"") if record.picture() else None,
        **details,
    )


def _of_dji(path: Path, name: str, data: bytes, meaning: Meaning) -> ThermalFrame:
    if meaning.planck is not None:
        raise SceneError(f"counts.planck are constants of FLIR's cameras; {path} is of DJI and holds kelvin")
    stated, xmp = dji.parameters_in(data), dji.xmp_in(data)
    details, camera = exif_details(data)
    height, width = dji.array_of(data).shape

    def number(key: str) -> float | None:
        try:
            return float(xmp[key])
        except (KeyError, ValueError):
            return None

    if (taken := taken_at(data)) is not None:
        details["time"] = taken
    if (place := details.get("position")) is not None:
        spread = [s for s in (number("RtkStdLat"), number("RtkStdLon")) if s is not None]
        details["position"] = replace(
            place,
            altitude_m=number("AbsoluteAltitude") or place.altitude_m,
            above_takeoff_m=number("RelativeAltitude"),
            horizontal_sd_m=float(np.hypot(*spread)) if len(spread) == 2 else None,
            vertical_sd_m=number("RtkStdHgt"),
        )
    angles = [number(f"Gimbal{axis}Degree") for axis in ("Yaw", "Pitch", "Roll")]
    if all(angle is not None for angle in angles):
        details["attitude"] = Attitude(*angles)
    return ThermalFrame(
        name,
        path,
        0,
        load=lambda: dji.array_of(read_bytes(path)),
        calibration=meaning.of_temperatures(1.0 / dji.PER_KELVIN, -KELVIN_AT_0_C),
        conditions=Conditions(**stated),
        sources=dict.fromkeys(stated, "file"),
        camera=replace(camera, serial=xmp.get("CameraSerialNumber") or camera.serial),
        size=(width, height),
        **details,
    )


def taken_at(data: bytes) -> datetime | None:
    """When a picture was taken: DJI's UTC at the exposure, or EXIF's clock, with a zone where it says one; None without."""
    if text := dji.xmp_in(data).get("UTCAtExposure"):
        try:
            return datetime.fromisoformat(text).replace(tzinfo=UTC)
        except ValueError:
            log.debug("UTCAtExposure is %r", text)
    return exif_in(data).get("time")


def exif_details(source: bytes | Path) -> tuple[dict[str, object], CameraInfo]:
    """(time and position as arguments of a frame, camera) as far as the EXIF of a picture, or of its file, has them."""
    found = exif_in(source) if source else {}
    details = {"time": found["time"]} if "time" in found else {}
    if "latitude_deg" in found:
        details["position"] = Position(found["latitude_deg"], found["longitude_deg"], found.get("altitude_m"))
    return details, CameraInfo(found.get("make"), found.get("model"), found.get("serial"), found.get("focal_mm"))
