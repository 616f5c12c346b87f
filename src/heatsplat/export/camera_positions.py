"""Tables of where cameras stood on the earth, as preparation writes them and as other programs do."""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

from heatsplat.contracts import Frame, SceneError, number_in, table_lines, text_in
from heatsplat.io.tables import SPELLINGS

# Spellings of the columns; of heights, a preparation writes a column for each kind, empty where files do not say it.
NAMES, LATITUDES, LONGITUDES = (SPELLINGS[key] for key in ("name", "latitude_deg", "longitude_deg"))
HEIGHTS = ("above_takeoff_m", "altitude_m", "altitude", "rel_alt", "alt")


def read_positions(path: Path, flat: bool = False) -> dict[str, tuple[float, float, float]]:
    """Latitude, longitude and height by name without ending; rows without a position are left out, as are those of latitude and
    longitude 0, which receivers tell until they know better.

    Args:
        path: the table.
        flat: heights are 0 where it has none.

    Raises:
        SceneError: it cannot be read, lacks a column, or a number is none or no place on the earth.
    """
    rows = _rows(path)
    name, *numbers = columns = _columns(path, rows, flat)
    level = () if len(numbers) == 3 else (0.0,)
    try:
        found = {
            _without_ending(row[name]): (*(number_in(_told(row, n).replace(",", ".")) for n in numbers), *level)
            for row in rows
            if all(_told(row, n) for n in columns)
        }
    except ValueError as error:
        raise SceneError(f"{path}: {error} in {', '.join(numbers)}") from error
    found = {name: place for name, place in found.items() if all(map(math.isfinite, place)) and any(place[:2])}
    for name, (latitude, longitude, _) in found.items():
        if abs(latitude) > 90 or abs(longitude) > 360:
            raise SceneError(
                f"{path}: {name} lies nowhere on the earth, at latitude {latitude:g} and longitude {longitude:g} degrees"
            )
    return found


def named(frames: Sequence[Frame], positions: Mapping[str, Any]) -> list[str | None]:
    """By which name the position of each image is known: its own, or that of its file where no other has it."""
    stems = Counter(PurePosixPath(name).name for name in positions)
    alone = {stem: name for stem, name in ((PurePosixPath(name).name, name) for name in positions) if stems[stem] == 1}
    ours = Counter(PurePosixPath(_without_ending(frame.name)).name for frame in frames)
    found = []
    for frame in frames:
        whole = _without_ending(frame.name)
        stem = PurePosixPath(whole).name
        found.append(whole if whole in positions else alone.get(stem) if ours[stem] == 1 else None)
    return found


def _rows(path: Path) -> list[dict[str, str | None]]:
    try:
        lines = [line for _, line in table_lines(text_in(path.read_bytes()))]
        return list(csv.DictReader(lines, delimiter=max(",;\t", key=(lines or [""])[0].count)))
    except (OSError, ValueError, csv.Error) as error:
        raise SceneError(f"{path} cannot be read: {error}") from error


def _columns(path: Path, rows: Sequence[Mapping[str, str | None]], flat: bool) -> list[str]:
    """Names of the columns of name, latitude, longitude and, unless all is ``flat`` and none says any, height: of those that a
    table has of each, the first that is not empty."""
    # Without None, under which stands what a row has beyond the last column.
    filled = {
        column: any(_told(row, column) for row in rows) for column in (rows[0] if rows else ()) if column is not None
    }
    columns = []
    for spellings in (NAMES, LATITUDES, LONGITUDES, HEIGHTS):
        there = [column for column in spellings if column in filled]
        told = [column for column in there if filled[column]]
        if spellings is HEIGHTS and flat and not told:
            break
        if not there:
            raise SceneError(f"{path} has no column {' or '.join(spellings)}")
        columns.append((told or there)[0])
    return columns


def _told(row: Mapping[str, str | None], column: str) -> str:
    """What a row says in a column, which short rows lack; empty for blanks."""
    return (row[column] or "").strip()


def _without_ending(name: str) -> str:
    """A file's name without its ending, which begins with a letter: that of "2024-08-06_17.34.49" has none."""
    path = PurePosixPath(Path(name.strip()).as_posix())
    return (path.with_suffix("") if path.suffix[1:2].isalpha() else path).as_posix()
