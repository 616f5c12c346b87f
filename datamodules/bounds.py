"""Files that say which temperatures black and white stand for: in all images of a scene, or in each of them."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from heatsplat.contracts import SceneError, ThermalRange, counted
from heatsplat.datamodules.file_names import same_files
from heatsplat.datamodules.side_files import Table, finite, json_object, read_table, says_fahrenheit, says_kelvin
from heatsplat.physics.units import KELVIN_AT_0_C

log = logging.getLogger(__name__)

BOUNDS_FILE = "temperature_bounds.json"
BOUNDS_TABLE = "temperature_bounds.csv"  # a span for each image, as cameras set anew that choose it by themselves
NAMES, LOWER, UPPER = ("file", "name", "image"), "min_c", "max_c"  # columns of such a table
BESIDE = 1.01 / 255.0  # of a span that counts as its end: JPEG moves most of what is cut off by no more than one level
NAMED = 3  # images that a message names
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


def union(ranges: Iterable[ThermalRange]) -> ThermalRange:
    """The least range that holds all of one or more."""
    found = list(ranges)
    return ThermalRange(min(one.min_c for one in found), max(one.max_c for one in found))


def span_in(table: Table, line: int, low: str, high: str) -> ThermalRange:
    """The span in two cells of a row of a table. Raises SceneError naming file and line where they are no rising temperatures."""
    ends = []
    for what, cell in (("minimum", low), ("maximum", high)):
        where = f"{table.path}, line {line}: the {what} {cell!r}"
        try:
            number = table.number(cell)
        except ValueError as error:
            raise SceneError(f"{where} is no number; give the °C of black and white of that image") from error
        ends.append(celsius(number, where))
    return range_in(f"{table.path}, line {line}", *ends)[0]


def ends_of(shares: np.ndarray, span: ThermalRange, bounds: ThermalRange) -> np.ndarray:
    """Where an image was cut off, [H, W] int8: 1 at the warm end of its span, -1 at the cold one, 0 elsewhere, and at an end
    beyond which the span of no image reaches by more than ``BESIDE``.

    Args:
        shares: [H, W] of the span that pixels lie above its cold end.
        span: of the image.
        bounds: that hold the spans of all images.
    """
    least = BESIDE * span.span_k
    above = (shares >= 1.0 - BESIDE) & (bounds.max_c - span.max_c > least)
    below = (shares <= BESIDE) & (span.min_c - bounds.min_c > least)
    return above.astype(np.int8) - below.astype(np.int8)


def spans_told(spans: Iterable[ThermalRange]) -> str:
    """How wide the spans of images are, in words."""
    widths = [span.span_k for span in spans]
    return f"each image has a span of its own, {min(widths):.3g} to {max(widths):.3g} °C wide"


@dataclass(frozen=True)
class Spans:
    """A span for each image, as a table has them.

    Args:
        path: of the table.
        by_name: the spans by names of files, as the table writes them.
    """

    path: Path
    by_name: Mapping[str, ThermalRange]

    @classmethod
    def read(cls, path: Path) -> Spans:
        """The spans in a table with the columns file, min_c and max_c.

        Raises:
            SceneError: it cannot be read, has no such columns, no rows, two spans for a file, or one that is none.
        """
        table = read_table(path)
        names = next((name for name in NAMES if name in table.columns), None)
        missing = [name for name in (LOWER, UPPER) if name not in table.columns]
        if names is None or missing:
            lacking = ", ".join(([f"{NAMES[0]} with names of images"] if names is None else []) + missing)
            raise SceneError(
                f"{path} has no column {lacking}; it has {', '.join(table.columns)}. A row for each image is needed: "
                f"{NAMES[0]},{LOWER},{UPPER}, the last two the °C of black and white"
            )
        at = [table.columns.index(name) for name in (names, LOWER, UPPER)]
        found: dict[str, ThermalRange] = {}
        for line, cells in table.rows:
            name, low, high = (cells[i] for i in at)
            span = span_in(table, line, low, high)
            if found.setdefault(name, span) != span:
                raise SceneError(f"{path}, line {line}: {name} has another span in a line above; keep one of them")
        if not found:
            raise SceneError(f"{path} has no rows; give one for each image, or take the file away")
        return cls(path, found)

    def whole(self) -> ThermalRange:
        """The range that holds all of them."""
        return union(self.by_name.values())

    def of(self, names: Sequence[str]) -> dict[str, ThermalRange]:
        """The span of each image, by its name; the log names rows that are of none.

        Raises:
            SceneError: an image has no row, or it cannot be told which is its.
        """
        found = {}
        rows = same_files(names, self.by_name)
        for name, several in rows.items():
            if len({self.by_name[row] for row in several}) > 1:
                raise SceneError(
                    f"{self.path}: {' and '.join(several)} have different spans and may both be {name}; write the folders of "
                    "images, too"
                )
            if several:
                found[name] = self.by_name[several[0]]
        if lacking := [name for name in names if name not in found]:
            raise SceneError(
                f"{self.path} has no row for {counted(len(lacking), 'image')} of {len(names)}, such as "
                f"{', '.join(lacking[:NAMED])}; it begins with {next(iter(self.by_name))}. Add the spans of these images, or "
                "take them out of the scene"
            )
        used = {row for several in rows.values() for row in several}
        if idle := [row for row in self.by_name if row not in used]:
            log.info(
                "%s: %s of no image that is used, such as %s",
                *(self.path, counted(len(idle), "row"), ", ".join(idle[:NAMED])),
            )
        return found


def bounds_in(folder: Path, swap: bool = False) -> tuple[ThermalRange | None, Spans | None, dict[str, Any]]:
    """What the files of a scene say of black and white: the range of all images, or the one that holds the spans of each, None
    where there is no such file; the spans, None where one range holds for all images; and a note on the source.

    Args:
        folder: of the scene.
        swap: whether bounds in the wrong order are taken in the right one, as tools of ThermoScenes do; spans never are.

    Raises:
        SceneError: a file cannot be used as it is, or both are there.
    """
    file, table = folder / BOUNDS_FILE, folder / BOUNDS_TABLE
    if table.is_file():
        if file.is_file():
            raise SceneError(
                f"{folder} has {BOUNDS_FILE}, one span for all images, and {BOUNDS_TABLE}, one for each: take away the one that "
                "does not hold"
            )
        spans = Spans.read(table)
        return spans.whole(), spans, {"bounds_source": table.name}
    if not file.is_file():
        return None, None, {}
    bounds, swapped = read_bounds(file, swap)
    return bounds, None, {"bounds_source": file.name + (" (minimum and maximum were swapped)" if swapped else "")}
