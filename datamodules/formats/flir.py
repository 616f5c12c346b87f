"""FLIR's FFF records: in radiometric JPEGs, in .fff files, and one after the other in .seq and .csq recordings.

The layout is that which ExifTool documents in its tables of FLIR tags. Nothing in a file is trusted: every offset is checked.
"""

from __future__ import annotations

import math
import mmap
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.jpeg import segments
from heatsplat.physics.radiometry import LIMITS, Atmosphere, Conditions, PlanckResponse

RAW_IMAGE, EMBEDDED_PICTURE, CAMERA, PALETTE, GPS = 1, 14, 32, 34, 43  # kinds of records
MOST_RECORDS = 4096
MOST_PIXELS = 1 << 26


@dataclass(frozen=True)
class Measured:
    """What the camera record of a FLIR frame says.

    Args:
        response: the camera's calibration.
        conditions: its object parameters; what is implausible in the file has the neutral value and no place in ``given``.
        given: names of the conditions that the file states.
        model, serial, field_of_view_deg, frame_rate_hz: of the camera; None where the file does not say.
        time: with the camera's zone, or None.
        latitude_deg, longitude_deg, altitude_m: of GPS, or None.
    """

    response: PlanckResponse
    conditions: Conditions
    given: tuple[str, ...]
    model: str | None = None
    serial: str | None = None
    field_of_view_deg: float | None = None
    frame_rate_hz: float | None = None
    time: datetime | None = None
    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None


def payload_of(data: bytes) -> bytes:
    """The FFF file inside a FLIR JPEG, or the data itself when they are one; empty without."""
    if data[:4] == b"FFF\0":
        return data
    blocks = {p[6]: p[8:] for marker, p in segments(data) if marker == 0xE1 and p[:5] == b"FLIR\0" and len(p) > 8}
    joined = b"".join(blocks[number] for number in sorted(blocks))
    return joined if joined[:4] == b"FFF\0" else b""


class Record:
    """One FFF file: its records, decoded when they are asked for.

    Args:
        data: the bytes of the file.
        name: of the file, for messages.

    Raises:
        SceneError: the directory of records is damaged.
    """

    def __init__(self, data: bytes, name: str) -> None:
        self.name = name
        try:
            order = ">" if struct.unpack_from(">I", data, 20)[0] in range(100, 200) else "<"
            start, count = struct.unpack_from(f"{order}II", data, 24)
            if count > MOST_RECORDS:
                raise SceneError(f"{name}: the FLIR data is damaged (it claims {count} records)")
            self.records: dict[int, bytes] = {}
            for i in range(count):
                kind = struct.unpack_from(f"{order}H", data, start + 32 * i)[0]
                offset, length = struct.unpack_from(f"{order}II", data, start + 32 * i + 12)
                if kind and offset + length <= len(data):
                    self.records.setdefault(kind, data[offset : offset + length])
        except struct.error as error:
            raise SceneError(f"{name}: the FLIR data is damaged (its directory of records ends early)") from error

    def _record(self, kind: int, what: str) -> bytes:
        if kind not in self.records:
            raise SceneError(f"{self.name}: the FLIR data is damaged or cut short (there is no complete {what})")
        return self.records[kind]

    def counts(self) -> np.ndarray:
        """The sensor's values [H, W] uint16. Raises SceneError where they are damaged."""
        record = self._record(RAW_IMAGE, "raw image")
        if len(record) < 32:
            raise SceneError(f"{self.name}: the FLIR data ends before its raw image")
        # The first number of a record is 2 when its own byte order is that in which it reads as 2.
        order = "<" if struct.unpack_from("<H", record)[0] == 2 else ">"
        width, height = struct.unpack_from(f"{order}HH", record, 2)
        pixels = record[32:]
        if pixels[:4] == b"\x89PNG":
            return self._sized(_png(pixels, self.name).byteswap(), width, height)  # FLIR swaps the bytes of its PNGs
        if pixels[:3] == b"\xff\xd8\xff":
            return self._sized(_jpeg_ls(pixels, self.name), width, height)
        if not width * height or len(pixels) < width * height * 2:
            raise SceneError(
                f"{self.name}: the FLIR data ends before its {width}x{height} raw image is complete; copy it again"
            )
        return np.frombuffer(pixels, f"{order}u2", width * height).reshape(height, width).astype(np.uint16)

    def _sized(self, image: np.ndarray, width: int, height: int) -> np.ndarray:
        if width * height and image.shape != (height, width):
            raise SceneError(
                f"{self.name}: the FLIR data says {width}x{height}, its raw image is {image.shape[1]}x{image.shape[0]}; "
                "copy the file again"
            )
        return image

    def size(self) -> tuple[int, int]:
        """(width, height) of the raw image as its record says. Raises SceneError where there is none."""
        record = self._record(RAW_IMAGE, "raw image")
        if len(record) < 32:
            raise SceneError(f"{self.name}: the FLIR data ends before its raw image")
        order = "<" if struct.unpack_from("<H", record)[0] == 2 else ">"
        return struct.unpack_from(f"{order}HH", record, 2)

    def picture(self) -> bytes | None:
        """The photo of the camera's second lens as the bytes of a JPEG or PNG, or None."""
        pixels = self.records.get(EMBEDDED_PICTURE, b"")[32:]
        return pixels if pixels[:2] == b"\xff\xd8" or pixels[:4] == b"\x89PNG" else None

    def palette(self) -> np.ndarray | None:
        """Luma (0 .. 255), red and blue chroma (around 0) [N, 3] float64 of the picture's colours from cold to hot, or None."""
        record = self.records.get(PALETTE, b"")
        count = record[0] if record else 0
        entries = record[0x70 : 0x70 + 3 * count]
        if count < 2 or len(entries) < 3 * count:
            return None
        return np.frombuffer(entries, np.uint8).reshape(count, 3) - np.array([0.0, 128.0, 128.0])

    def measured(self) -> Measured:
        """Calibration and object parameters. Raises SceneError where no plausible calibration is in the file."""
        record = self._record(CAMERA, "camera record")
        declared = "<" if record[:2] == b"\x02\0" else ">"
        for order in (declared, "><"[declared == ">"]):  # the order in which the constants are possible
            try:
                response = _response(record, order)
            except struct.error as error:
                raise SceneError(f"{self.name}: the FLIR data is damaged (its camera record ends early)") from error
            if response is not None:
                conditions, given = _conditions(record, order)
                details = _details(record, order) | _gps(self.records.get(GPS, b""))
                return Measured(response, conditions, given, **details)
        raise SceneError(f"{self.name}: the FLIR camera record holds no plausible Planck constants")


def _png(pixels: bytes, name: str) -> np.ndarray:
    try:
        image = cv2.imdecode(np.frombuffer(pixels, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.dtype != np.uint16 or image.ndim != 2:
        raise SceneError(f"{name}: the 16-bit PNG inside the FLIR data cannot be decoded; copy the file again")
    return image


def _jpeg_ls(pixels: bytes, name: str) -> np.ndarray:
    """Decoded by CharLS. Raises ImportError naming the extra where it is not installed."""
    try:
        import imagecodecs
    except ImportError as error:
        raise ImportError(
            f"{name} is compressed as JPEG-LS (.csq): pip install 'heatsplat[csq]', or export it as .seq or 16-bit TIFF"
        ) from error
    try:
        image = imagecodecs.jpegls_decode(pixels)
    except Exception as error:  # of CharLS, which has its own
        raise SceneError(f"{name}: its JPEG-LS image cannot be decoded ({error}); copy the file again") from error
    if image.dtype not in (np.uint8, np.uint16) or image.ndim != 2 or image.size > MOST_PIXELS:
        raise SceneError(f"{name}: its JPEG-LS image is no image of counts")
    return image.astype(np.uint16)


def _response(record: bytes, order: str) -> PlanckResponse | None:
    r1, b, f = struct.unpack_from(f"{order}fff", record, 0x58)
    o, r2 = struct.unpack_from(f"{order}if", record, 0x308)
    possible = 1 < r1 < 1e9 and 500 < b < 5000 and 0 < f < 100 and abs(o) < 1e5 and 1e-6 < r2 <= 10
    return PlanckResponse(r1, b, f, o, r2) if possible else None


def _conditions(record: bytes, order: str) -> tuple[Conditions, tuple[str, ...]]:
    emissivity, distance, reflected, air, window, through, _, humidity = struct.unpack_from(f"{order}8f", record, 0x20)
    stated = {
        "emissivity": emissivity,
        "distance_m": distance,
        "reflected_k": reflected,
        "air_k": air,
        "window_k": window,
        "window_transmission": through,
        "humidity": humidity / 100 if humidity > 2 else humidity,  # some cameras write per cent
    }
    kept = {name: value for name, value in stated.items() if LIMITS[name][0] <= value <= LIMITS[name][1]}
    air_constants = struct.unpack_from(f"{order}5f", record, 0x70)
    atmosphere = Atmosphere()
    if all(math.isfinite(value) and abs(value) < 10 for value in air_constants) and air_constants[4] > 0:
        atmosphere = Atmosphere(*air_constants)
    return Conditions(**kept, atmosphere=atmosphere), tuple(kept)


def _details(record: bytes, order: str) -> dict[str, Any]:
    def text(start: int, length: int) -> str | None:
        return record[start : start + length].partition(b"\0")[0].decode("latin-1").strip() or None

    found: dict[str, Any] = {"model": text(0xD4, 32), "serial": text(0x104, 16)}
    if len(record) >= 0x1B8 and 0 < (angle := struct.unpack_from(f"{order}f", record, 0x1B4)[0]) < 180:
        found["field_of_view_deg"] = angle
    if len(record) >= 0x38E:
        seconds, thousandths, minutes = struct.unpack_from(f"{order}IIh", record, 0x384)
        if seconds and abs(minutes) < 24 * 60:
            zone = timezone(timedelta(minutes=-minutes))  # the record counts zones westward
            moment = datetime.fromtimestamp(seconds, UTC) + timedelta(milliseconds=min(thousandths & 0xFFFF, 999))
            found["time"] = moment.astimezone(zone)
    if len(record) >= 0x466 and (rate := struct.unpack_from(f"{order}H", record, 0x464)[0]):
        found["frame_rate_hz"] = float(rate)
    return found


def _gps(record: bytes) -> dict[str, Any]:
    if len(record) < 0x24 or struct.unpack_from("<I", record)[0] != 1:
        return {}
    latitude, longitude = struct.unpack_from("<dd", record, 0x10)
    altitude = struct.unpack_from("<f", record, 0x20)[0]
    if not (abs(latitude) <= 90 and abs(longitude) <= 180) or latitude == longitude == 0:
        return {}
    height = {"altitude_m": altitude} if -500 < altitude < 1e5 and altitude != -1 else {}
    return {"latitude_deg": latitude, "longitude_deg": longitude, **height}


def frames_in(path: Path) -> list[tuple[int, int]]:
    """(start, length) in bytes of every FFF frame of a .seq or .csq recording.

    Raises:
        SceneError: it cannot be read, or holds none.
    """
    try:
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            found = list(_frames(data))
    except (OSError, ValueError) as error:  # an empty file cannot be mapped
        raise SceneError(f"{path} cannot be read as a FLIR recording: {error}") from error
    if not found:
        raise SceneError(f"{path} holds no FLIR frame; is it a recording of another maker?")
    return found


def _frames(data: mmap.mmap) -> Iterator[tuple[int, int]]:
    at = data.find(b"FFF\0")
    while at >= 0:
        length = _length(data, at)
        if length:
            yield at, length
        at = data.find(b"FFF\0", at + max(length, 4))


def _length(data: mmap.mmap, at: int) -> int:
    """Bytes of the frame that begins there, or 0 where the marker stands there by chance or the frame is cut."""
    if at + 64 > len(data):
        return 0
    order = next((o for o in "><" if struct.unpack_from(f"{o}I", data, at + 20)[0] in range(100, 200)), None)
    if order is None:
        return 0
    start, count = struct.unpack_from(f"{order}II", data, at + 24)
    end = start + 32 * count
    if not 0 < count <= MOST_RECORDS or at + end > len(data):
        return 0
    for i in range(count):
        kind = struct.unpack_from(f"{order}H", data, at + start + 32 * i)[0]
        offset, length = struct.unpack_from(f"{order}II", data, at + start + 32 * i + 12)
        end = max(end, offset + length) if kind else end
    return end if at + end <= len(data) else 0


def read_part(path: Path, start: int, length: int) -> bytes:
    """Bytes of a file. Raises SceneError where it cannot be read."""
    try:
        with path.open("rb") as file:
            file.seek(start)
            return file.read(length)
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}") from error
