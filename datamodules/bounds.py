"""Files that say which temperatures black and white stand for."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneError, ThermalRange
from heatsplat.datamodules.side_files import finite, json_object, says_fahrenheit, says_kelvin
from heatsplat.physics.units import KELVIN_AT_0_C

BOUNDS_FILE = "temperature_bounds.json"
# °C that a camera can read: from absolute zero to beyond any thermal camera.
MIN_CELSIUS, MAX_CELSIUS = -KELVIN_AT_0_C, 10_000.0


def celsius(value: Any, where: str) -> float:
    """A temperature in °C. Raises SceneError naming ``where`` when it is no number, or below absolute zero."""
    number = finite(value, where, "a number in °C")
    if not MIN_CELSIUS <= number <= MAX_CELSIUS:
        raise SceneError(f"{where} is {number:g} °C; temperatures lie between {MIN_CELSIUS} and {MAX_CELSIUS:g} °C")
    return number


def celsius_in(values: Mapping[str, Any], key: str, path: Path) -> float:
    """The temperature under ``key``. Raises SceneError naming file and key when it is missing or none, or in °F or kelvin."""
    for name, unit in values.items():
        if "unit" not in name.lower() or not isinstance(unit, str):
            continue
        told = f"unit: {unit}"
        if instead := "(F - 32) / 1.8" if says_fahrenheit(told) else "K - 273.15" if says_kelvin(told) else None:
            raise SceneError(
                f"{path}: {name!r} is {unit!r}, and temperatures are read in °C: write {instead} for each, and leave {name!r} out"
            )
    if key not in values:
        raise SceneError(f"{path} has no key {key!r}; it has {', '.join(values) or 'none'}")
    return celsius(values[key], f"{path}: {key!r}")


def range_in(source: Path | str, low: float, high: float, swap: bool = False) -> tuple[ThermalRange, bool]:
    """The range of two bounds in °C, and whether they had to be swapped.

    Raises:
        SceneError: the bounds are equal or no temperatures, or swapped while ``swap`` is False; ``source`` is named.
    """
    low, high = celsius(low, f"{source}: the minimum"), celsius(high, f"{source}: the maximum")
    if low == high:
        raise SceneError(f"{source}: minimum and maximum are both {low} °C; bounds must differ")
    if low > high and not swap:
        raise SceneError(f"{source}: the minimum {low} °C lies above the maximum {high} °C; swap the two")
    return ThermalRange(min(low, high), max(low, high)), low > high


def read_bounds(path: Path, swap: bool = False) -> tuple[ThermalRange, bool]:
    """The range in a temperature_bounds.json (ThermoScenes' keys), and whether its bounds had to be swapped.

    Raises:
        SceneError: unreadable file, missing key, equal bounds, or swapped ones while ``swap`` is False.
    """
    values = json_object(path)
    low = celsius_in(values, "absolute_min_temperature", path)
    high = celsius_in(values, "absolute_max_temperature", path)
    return range_in(path, low, high, swap)
