"""Files as thermal cameras write them, for tests."""

from __future__ import annotations

import struct
from datetime import datetime

import cv2
import numpy as np

from heatsplat.physics.radiometry import PlanckResponse

WIDTH, HEIGHT = 40, 32  # as in layouts.py
PLANCK = PlanckResponse(r1=16000.0, b=1430.0, f=1.0, o=-7000, r2=0.012)
STATED = {  # offsets of the object parameters in FLIR's camera record
    "emissivity": (0x20, 0.95),
    "distance_m": (0x24, 12.0),
    "reflected_k": (0x28, 293.65),
    "air_k": (0x2C, 288.15),
    "window_k": (0x30, 295.15),
    "window_transmission": (0x34, 0.9),
    "humidity": (0x3C, 0.4),
}


def camera_record(order="<", stated=None, taken: datetime | None = None):
    """A camera record of FLIR with calibration, object parameters, model, serial number and time."""
    record = bytearray(0x480)
    struct.pack_into(f"{order}H", record, 0, 2)
    struct.pack_into(f"{order}fff", record, 0x58, PLANCK.r1, PLANCK.b, PLANCK.f)
    struct.pack_into(f"{order}i", record, 0x308, PLANCK.o)
    struct.pack_into(f"{order}f", record, 0x30C, PLANCK.r2)
    struct.pack_into(f"{order}5f", record, 0x70, 0.006569, 0.01262, -0.002276, -0.00667, 1.9)
    for name, value in (stated or {}).items():
        struct.pack_into(f"{order}f", record, STATED[name][0], value)
    record[0xD4:0xE0] = b"Test Cam 640"
    record[0x104:0x108] = b"S123"
    if taken is not None:
        west = -int(taken.utcoffset().total_seconds() // 60)
        struct.pack_into(f"{order}IIh", record, 0x384, int(taken.timestamp()), taken.microsecond // 1000, west)
    struct.pack_into(f"{order}H", record, 0x464, 30)
    return bytes(record)


def gps_record(latitude, longitude, altitude):
    record = bytearray(0x60)
    struct.pack_into("<I", record, 0, 1)
    struct.pack_into("<ddf", record, 0x10, latitude, longitude, altitude)
    return bytes(record)


def fff(raw, order="<", png=False, pixels=None, camera=None, gps=None, picture=None, palette=None):
    """An FFF file with a raw image, a camera record in the given byte order, and more records where they are given."""
    head = bytearray(32)
    struct.pack_into(f"{order}HHH", head, 0, 2, raw.shape[1], raw.shape[0])
    if pixels is None:
        pixels = raw.astype(f"{order}u2").tobytes()
        if png:
            pixels = cv2.imencode(".png", raw.byteswap())[1].tobytes()
    records = [(1, bytes(head) + pixels), (32, camera or camera_record(order))]
    records += [(43, gps)] if gps else []
    records += [(14, bytes(32) + picture)] if picture else []
    records += [(34, palette)] if palette else []
    header = bytearray(64)
    header[:4] = b"FFF\0"
    struct.pack_into(">III", header, 20, 100, 64, len(records))
    directory = bytearray(32 * len(records))
    start = 64 + len(directory)
    for i, (kind, record) in enumerate(records):
        struct.pack_into(">H", directory, 32 * i, kind)
        struct.pack_into(">II", directory, 32 * i + 12, start, len(record))
        start += len(record)
    return bytes(header) + bytes(directory) + b"".join(record for _, record in records)


def palette_record(luma_red_blue):
    """A record of colours [N, 3] uint8 in FLIR's order: luma, red and blue chroma."""
    return bytes([len(luma_red_blue)]) + bytes(0x6F) + luma_red_blue.astype(np.uint8).tobytes()


def jpeg_with(marker, blocks, shown=None):
    """A JPEG with extra segments after its first marker; ``shown`` is the picture in it, greys or RGB."""
    shown = np.full((HEIGHT, WIDTH), 90, np.uint8) if shown is None else shown[..., ::-1] if shown.ndim == 3 else shown
    picture = cv2.imencode(".jpg", shown)[1].tobytes()
    segments = b"".join(bytes([0xFF, marker]) + struct.pack(">H", len(b) + 2) + b for b in blocks)
    return picture[:2] + segments + picture[2:]


def flir_jpeg(raw, shown=None, **options):
    data = fff(raw, **options)
    parts = [data[i : i + 2000] for i in range(0, len(data), 2000)]
    blocks = [b"FLIR\0\x01" + bytes([i, len(parts) - 1]) + part for i, part in enumerate(parts)]
    return jpeg_with(
        0xE1, [b"Exif\0\0nothing", *blocks[::-1]], shown
    )  # blocks are numbered, their order does not count


def dji_jpeg(raw):
    data = raw.astype("<u2").tobytes()
    return jpeg_with(0xE3, [data[i : i + 65000] for i in range(0, len(data), 65000)])


def with_segment(jpeg, marker, payload):
    """A JPEG with one more segment in front."""
    return jpeg[:2] + bytes([0xFF, marker]) + struct.pack(">H", len(payload) + 2) + payload + jpeg[2:]


def raw_for(celsius):
    """Raw values that the Planck formula turns into temperatures, from the formula's inverse."""
    signal = PLANCK.r1 / (np.exp(PLANCK.b / (celsius + 273.15)) - PLANCK.f)
    return np.rint(signal / PLANCK.r2 - PLANCK.o).astype(np.uint16)


def temperatures(index=0, height=HEIGHT, width=WIDTH):
    y, x = np.mgrid[:height, :width]
    return 10 + 0.4 * x + 0.2 * y + index
