"""What DJI's thermal cameras write into their R-JPEGs: the sensor's array, object parameters, and where the drone was."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from typing import Any

import numpy as np

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.jpeg import segments
from heatsplat.physics.radiometry import LIMITS
from heatsplat.physics.units import KELVIN_AT_0_C

# DJI writes its sensor array without a header; these are the sizes its thermal cameras have.
SIZES = {640 * 512 * 2: (512, 640), 1280 * 1024 * 2: (1024, 1280)}
RANGE_C = (-60.0, 650.0)
PER_KELVIN = 64.0  # counts where the array holds temperatures (M3T and some M4T files)

# What to run where the array holds counts, or is not there; docs/your_own_data.md has the whole of it.
CONVERT = (
    "only DJI's Thermal SDK converts them: dji_irp -s IMAGE.JPG -a measure --measurefmt float32 -o IMAGE.raw for each file, "
    "then make a float TIFF of each .raw (docs/your_own_data.md, Files of DJI)"
)

# Object parameters of the M3T's kind (ExifTool's ThermalParams2): five floats, then a mark of their block 32 bytes on.
_PARAMETERS_MARK = b"\x2c\x01\x20\x00"
_XMP_VALUE = re.compile(rb'drone-dji:(\w+)\s*=\s*"([^"]{0,200})"')


def array_of(data: bytes) -> np.ndarray | None:
    """The sensor's array [H, W] uint16 of an R-JPEG, or None when a file has none."""
    joined = b"".join(payload for marker, payload in segments(data) if marker == 0xE3)
    return np.frombuffer(joined, "<u2").reshape(SIZES[len(joined)]) if len(joined) in SIZES else None


def is_thermal(data: bytes) -> bool:
    """Whether a picture is one of a DJI thermal camera, even where its array is cut or of an unknown size."""
    stored = [payload for marker, payload in segments(data) if marker in (0xE3, 0xE4)]
    said = xmp_in(data)
    return said.get("ImageSource") == "InfraredCamera" or bool(stored) and (bool(said) or b"iirp" in stored[-1][:16])


def holds_temperatures(counts: np.ndarray) -> bool:
    """Whether an array holds 1/64 K in steps of 1/16 K, and not counts that only DJI's SDK converts."""
    celsius = counts / PER_KELVIN - KELVIN_AT_0_C
    return not (counts % 4).any() and celsius.min() >= RANGE_C[0] and celsius.max() <= RANGE_C[1]


def temperatures(counts: np.ndarray, path: Path) -> np.ndarray:
    """Apparent temperatures in °C [H, W] float32 of an array that holds 1/64 K.

    Raises:
        SceneError: it holds counts that only DJI's SDK converts.
    """
    if not holds_temperatures(counts):
        raise SceneError(
            f"{path}: its sensor values are not multiples of 1/16 K (as in M3T files) but counts; {CONVERT}. "
            "data.radiometric=never takes the pictures as greys"
        )
    return counts.astype(np.float32) / PER_KELVIN - np.float32(KELVIN_AT_0_C)


def parameters_in(data: bytes) -> dict[str, float]:
    """Object parameters by the names of ``radiometry.Conditions``; none where the file has none that are known."""
    for marker, payload in segments(data):
        if marker != 0xE4:
            continue
        for start in (0, 32):
            if payload[start + 32 : start + 36] == _PARAMETERS_MARK:
                air, distance, emissivity, humidity, reflected = struct.unpack_from("<5f", payload, start)
                stated = {
                    "air_k": air + KELVIN_AT_0_C,
                    "distance_m": distance,
                    "emissivity": emissivity,
                    "humidity": humidity,
                    "reflected_k": reflected + KELVIN_AT_0_C,
                }
                return {name: x for name, x in stated.items() if LIMITS[name][0] <= x <= LIMITS[name][1]}
    return {}


def xmp_in(data: bytes) -> dict[str, str]:
    """Values of DJI's own XMP by name, such as {"RelativeAltitude": "+75.002"}."""
    found: dict[str, Any] = {}
    for marker, payload in segments(data):
        if marker == 0xE1 and payload.startswith(b"http://ns.adobe.com/xap/1.0/\0"):
            found |= {key.decode(): value.decode("utf-8", "replace") for key, value in _XMP_VALUE.findall(payload)}
    return found
