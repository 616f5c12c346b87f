"""Temperatures inside radiometric files: FLIR JPEG and .fff, DJI R-JPEG.

Temperatures are apparent ones: emissivity 1, no reflected radiation, no atmosphere in between.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from heatsplat.contracts import SceneError
from heatsplat.physics.units import KELVIN_AT_0_C

# DJI writes its sensor array without a header; these are the sizes its thermal cameras have.
DJI_SIZES = {640 * 512 * 2: (512, 640), 1280 * 1024 * 2: (1024, 1280)}
DJI_RANGE_C = (-60.0, 650.0)


@dataclass(frozen=True)
class Planck:
    """A FLIR camera's calibration: °C = B / ln(R1 / (R2 (raw + O)) + F) - 273.15."""

    r1: float
    b: float
    f: float
    o: float
    r2: float

    def celsius(self, raw: np.ndarray) -> np.ndarray:
        """Apparent temperatures in °C of raw values, float32; NaN where the formula has no answer."""
        signal = self.r2 * (raw.astype(np.float64) + self.o)
        with np.errstate(divide="ignore", invalid="ignore"):
            kelvin = self.b / np.log(self.r1 / signal + self.f)
        return np.where((signal > 0) & (kelvin > 0), kelvin - KELVIN_AT_0_C, np.nan).astype(np.float32)


def _jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(marker, payload) of the segments before the first scan of a JPEG."""
    if data[:2] != b"\xff\xd8":
        return
    at = 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        length = int.from_bytes(data[at + 2 : at + 4], "big")
        if length < 2:
            return
        yield data[at + 1], data[at + 4 : at + 2 + length]
        at += 2 + length


def _flir_payload(data: bytes) -> bytes:
    """The FFF file inside a FLIR JPEG, or the data itself when they are one; empty without."""
    if data[:4] == b"FFF\0":
        return data
    blocks = {p[6]: p[8:] for marker, p in _jpeg_segments(data) if marker == 0xE1 and p[:5] == b"FLIR\0" and len(p) > 8}
    return b"".join(blocks[number] for number in sorted(blocks))


def _dji_payload(data: bytes) -> bytes:
    """The joined APP3 segments of a JPEG, or nothing when they are no sensor array of a DJI camera."""
    joined = b"".join(payload for marker, payload in _jpeg_segments(data) if marker == 0xE3)
    return joined if len(joined) in DJI_SIZES else b""


def has_temperatures(path: Path) -> bool:
    """True when a file carries raw sensor data of FLIR or DJI."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(f"image {path} cannot be read: {error.strerror}") from error
    return _flir_payload(data)[:4] == b"FFF\0" or bool(_dji_payload(data))


def read_celsius(path: Path) -> np.ndarray:
    """Apparent temperatures in °C [H, W] float32 of a radiometric file.

    Raises:
        SceneError: no radiometric data, a damaged record, a compression that is not supported, or sensor counts of a
            DJI camera that only DJI's SDK can convert.
    """
    data = path.read_bytes()
    if (payload := _flir_payload(data))[:4] == b"FFF\0":
        raw, planck = read_fff(payload, path)
        return planck.celsius(raw)
    if payload := _dji_payload(data):
        return _dji_celsius(payload, path)
    raise SceneError(f"{path} carries no raw data of FLIR or DJI; use it as a plain image (data.radiometric=never)")


def read_fff(data: bytes, path: Path) -> tuple[np.ndarray, Planck]:
    """Raw sensor values [H, W] uint16 and the calibration of one FFF record file.

    Raises:
        SceneError: a record is missing or damaged, or the raw image is compressed in a way that cannot be read.
    """
    try:
        order = ">" if struct.unpack_from(">I", data, 20)[0] in range(100, 200) else "<"
        start, count = struct.unpack_from(f"{order}II", data, 24)
        records: dict[int, bytes] = {}
        for i in range(count):
            kind = struct.unpack_from(f"{order}H", data, start + 32 * i)[0]
            offset, length = struct.unpack_from(f"{order}II", data, start + 32 * i + 12)
            if kind in (1, 32):
                records.setdefault(kind, data[offset : offset + length])
        return _raw_image(records[1], path), _planck(records[32], path)
    except (KeyError, struct.error) as error:
        raise SceneError(f"{path}: the FLIR data is damaged (no complete raw image and camera record)") from error


def _raw_image(record: bytes, path: Path) -> np.ndarray:
    """Sensor values [H, W] uint16 of a raw image record."""
    # The first number of a record is 2 when its own byte order is that in which it reads as 2.
    order = "<" if struct.unpack_from("<H", record)[0] == 2 else ">"
    width, height = struct.unpack_from(f"{order}HH", record, 2)
    pixels = record[32:]
    if pixels[:4] == b"\x89PNG":
        image = cv2.imdecode(np.frombuffer(pixels, np.uint8), cv2.IMREAD_UNCHANGED)
        if image is None or image.dtype != np.uint16:
            raise SceneError(f"{path}: the 16-bit PNG inside the FLIR data cannot be decoded")
        return image.byteswap()  # FLIR stores the PNG's samples in the wrong byte order
    if pixels[:2] == b"\xff\xd8":
        raise SceneError(
            f"{path}: the raw image is compressed as JPEG-LS, which cannot be read; export it as 16-bit TIFF"
        )
    if len(pixels) < width * height * 2 or not width * height:
        raise SceneError(f"{path}: the FLIR data ends before its {width}x{height} raw image is complete")
    return np.frombuffer(pixels, f"{order}u2", width * height).reshape(height, width).astype(np.uint16)


def _planck(record: bytes, path: Path) -> Planck:
    """Calibration in a camera record; the byte order is the one in which the constants are possible."""
    for order in "<>":
        r1, b, f = struct.unpack_from(f"{order}fff", record, 0x58)
        o = struct.unpack_from(f"{order}i", record, 0x308)[0]
        r2 = struct.unpack_from(f"{order}f", record, 0x30C)[0]
        if 1 < r1 < 1e9 and 500 < b < 5000 and 0 < f < 100 and abs(o) < 1e5 and 1e-6 < r2 <= 10:
            return Planck(r1, b, f, o, r2)
    raise SceneError(f"{path}: the FLIR camera record holds no plausible Planck constants")


def _dji_celsius(payload: bytes, path: Path) -> np.ndarray:
    """Apparent temperatures in °C of a DJI sensor array, where it holds 1/64 K (M3T and some M4T files)."""
    raw = np.frombuffer(payload, "<u2").reshape(DJI_SIZES[len(payload)])
    celsius = raw.astype(np.float32) / 64.0 - KELVIN_AT_0_C
    if (raw % 4).any() or celsius.min() < DJI_RANGE_C[0] or celsius.max() > DJI_RANGE_C[1]:
        raise SceneError(
            f"{path}: its sensor values are not multiples of 1/16 K (as in M3T files) but counts that only DJI's "
            "Thermal SDK converts; export temperatures as TIFF with it, or use the pictures with data.radiometric=never"
        )
    return celsius.astype(np.float32)
