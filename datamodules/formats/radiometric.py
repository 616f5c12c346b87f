"""Apparent temperatures out of radiometric files, of whichever maker: FLIR JPEG and .fff, DJI R-JPEG.

Apparent ones: emissivity 1, no reflected radiation, no atmosphere in between.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import SceneError
from heatsplat.datamodules.bounds import MAX_CELSIUS
from heatsplat.datamodules.formats import dji, flir
from heatsplat.datamodules.formats.images import read_bytes, read_image, tiff_text
from heatsplat.datamodules.side_files import says_fahrenheit, says_kelvin
from heatsplat.physics.radiometry import BandResponse, Conditions, Response, surface_temperature
from heatsplat.physics.units import KELVIN_AT_0_C, MAYBE_KELVIN


@dataclass(frozen=True)
class Calibration:
    """What the numbers in a file mean.

    Args:
        response: of the camera, whose signal the numbers are where there is no ``scale``.
        scale, offset_c: °C = scale * number + offset_c, an apparent temperature.
    """

    response: Response = BandResponse()
    scale: float | None = None
    offset_c: float = 0.0

    def apparent_k(self, stored: Tensor) -> Tensor:
        """Temperatures in kelvin of black bodies that the camera would have seen so; NaN where there are none."""
        if self.scale is None:
            return self.response.kelvin(stored)
        found = self.scale * stored + (self.offset_c + KELVIN_AT_0_C)
        return torch.where(found > 0, found, math.nan)

    def signal(self, stored: Tensor) -> Tensor:
        """The camera's signal, in which radiation adds up."""
        return stored if self.scale is None else self.response.signal(self.apparent_k(stored))

    def surface_k(self, stored: Tensor, conditions: Conditions) -> Tensor:
        """Temperatures in kelvin of the surfaces behind the numbers; NaN where there are none."""
        if not conditions.corrects:
            return self.apparent_k(stored)
        return surface_temperature(self.signal(stored), self.response, conditions)


CELSIUS = Calibration(scale=1.0)
# Settings of a preparation that make °C of °F, and of kelvin.
CELSIUS_OF_FAHRENHEIT = f"counts.scale={1 / 1.8:.6f} counts.offset_c={-32 / 1.8:.4f}"
CELSIUS_OF_KELVIN = f"counts.offset_c={-KELVIN_AT_0_C:g}"


def surface_celsius(stored: np.ndarray, calibration: Calibration, conditions: Conditions | None = None) -> np.ndarray:
    """Temperatures in °C [H, W] float32 of stored numbers [H, W], each distinct number once; NaN where unknown, or hotter than
    any camera reads, as the 3.4e38 is with which gdal_calc marks what it does not know.

    Args:
        conditions: one for the whole image; None for apparent temperatures.
    """
    values, where = np.unique(stored, return_inverse=True)
    kelvin = calibration.surface_k(torch.from_numpy(values.astype(np.float64)), conditions or Conditions())
    celsius = (kelvin.numpy() - KELVIN_AT_0_C).astype(np.float32)
    celsius[celsius > MAX_CELSIUS] = np.nan
    return celsius[where].reshape(stored.shape)


def has_temperatures(path: Path) -> bool:
    """True when a file carries raw sensor data of FLIR or DJI."""
    data = read_bytes(path)
    return bool(flir.payload_of(data)) or dji.array_of(data) is not None


def read_celsius(path: Path) -> np.ndarray:
    """Apparent temperatures in °C [H, W] float32 of a radiometric file; NaN where FLIR's formula has no answer.

    Raises:
        SceneError: no radiometric data, a damaged record, or sensor counts of a DJI camera that only DJI's SDK can convert.
    """
    data = read_bytes(path)
    if payload := flir.payload_of(data):
        record = flir.Record(payload, str(path))
        return surface_celsius(record.counts(), Calibration(record.measured().response))
    if (counts := dji.array_of(data)) is not None:
        return dji.temperatures(counts, path)
    raise SceneError(f"{path} carries no raw data of FLIR or DJI; use it as a plain image (data.radiometric=never)")


def read_thermal(path: Path) -> np.ndarray:
    """The pixels of a thermal image as they are stored (``read_image``); floating-point ones are °C.

    Raises:
        SceneError: as ``read_image``, or a floating-point TIFF says that its numbers are °F or kelvin.
    """
    pixels = read_image(path)
    if pixels.dtype == np.float32 and (other := other_unit(pixels, path)):
        unit, settings = other
        raise SceneError(
            f"{path} says that its numbers are {unit}, and °C are read. Make a scene in °C of the images: python src/prepare.py "
            f"source={path.parent} target=NEW_FOLDER {settings} poses=given poses.model=THIS_SCENE "
            "(counts.offset_c=0 alone where they are °C all the same)"
        )
    return pixels


def other_unit(pixels: np.ndarray, path: Path) -> tuple[str, str] | None:
    """The unit that a TIFF says its floating-point numbers have, and the settings of a preparation that make °C of them; None
    where it is °C, or not said. Kelvin that the numbers cannot be, as most are too small, are those of something else.
    """
    told = tiff_text(path)
    if says_fahrenheit(told):
        return "°F", CELSIUS_OF_FAHRENHEIT
    finite = pixels[np.isfinite(pixels)]
    if says_kelvin(told) and finite.size and np.median(finite) > MAYBE_KELVIN[0]:
        return "kelvin", CELSIUS_OF_KELVIN
    return None
