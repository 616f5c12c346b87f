"""Files that say which temperatures black and white stand for."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneError, ThermalRange


def read_json(path: Path) -> Any:
    """Content of a JSON file. Raises SceneError naming it when it cannot be parsed."""
    try:
        return json.loads(path.read_text())
    except (OSError, ValueError) as error:
        raise SceneError(f"{path} is not readable JSON: {error}") from error


def number_in(values: dict[str, Any], key: str, path: Path) -> float:
    """The number under ``key``. Raises SceneError naming file and key when it is missing or no number."""
    if key not in values:
        raise SceneError(f"{path} has no key {key!r}; it has {', '.join(values) or 'none'}")
    try:
        return float(values[key])
    except (TypeError, ValueError) as error:
        raise SceneError(f"{path}: {key!r} is {values[key]!r}, a number in °C is needed") from error


def range_in(path: Path, low: float, high: float, swap: bool = False) -> tuple[ThermalRange, bool]:
    """The range of two bounds in °C, and whether they had to be swapped.

    Raises:
        SceneError: the bounds are equal, or swapped and ``swap`` is False.
    """
    if low == high:
        raise SceneError(f"{path}: minimum and maximum are both {low} °C; bounds must differ")
    if low > high and not swap:
        raise SceneError(f"{path}: the minimum {low} °C lies above the maximum {high} °C; swap the two")
    return ThermalRange(min(low, high), max(low, high)), low > high


def read_bounds(path: Path, swap: bool = False) -> tuple[ThermalRange, bool]:
    """The range in a temperature_bounds.json (ThermoScenes' keys), and whether its bounds had to be swapped.

    Raises:
        SceneError: unreadable file, missing key, equal bounds, or swapped ones while ``swap`` is False.
    """
    values = read_json(path)
    low = number_in(values, "absolute_min_temperature", path)
    high = number_in(values, "absolute_max_temperature", path)
    return range_in(path, low, high, swap)
