"""What a table says of the frames of a recording: a row for each, or for the file that holds it."""

from __future__ import annotations

import logging
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from datetime import datetime
from pathlib import Path

from heatsplat.contracts import SceneError, ThermalRange, counted
from heatsplat.datamodules.bounds import LOWER, NAMED, UPPER, span_in
from heatsplat.datamodules.file_names import same_files
from heatsplat.datamodules.side_files import Table, read_table
from heatsplat.io.tables import SPELLINGS
from heatsplat.preparation.frame import Attitude, Position, ThermalFrame

log = logging.getLogger(__name__)

Row = tuple[int, list[str]]  # number of its line, and its cells

# Columns of a table that make up a position and an attitude.
NUMBERS = {
    Position: ("latitude_deg", "longitude_deg", "altitude_m", "above_takeoff_m"),
    Attitude: ("yaw_deg", "pitch_deg", "roll_deg"),
}
SPAN = (LOWER, UPPER)  # columns of the °C of black and white of a frame
MOST_DEG = {"latitude_deg": 90.0, "longitude_deg": 180.0}


def with_table(
    frames: Sequence[ThermalFrame], path: Path, columns: Mapping[str, str], notes: list[str]
) -> list[ThermalFrame]:
    """Frames with what a table says of them, which goes before what their files say.

    Args:
        frames: of the recording.
        path: of the table.
        columns: its columns by what they hold: name, time, latitude_deg, ...
        notes: gets a sentence on what the table tells, and one on columns that are not used.

    Raises:
        SceneError: the table has no row for any frame or several for one, or no column that is known, or a cell cannot be read.
    """
    table = FrameTable.read(path, columns)
    rows = table.rows_of(frames)
    used: set[str] = set()
    changed = []
    for frame in frames:
        if frame.name in rows:
            changes, read = table.changes(frame, rows[frame.name])
            frame = replace(frame, **changes)
            used |= read | (set(SPAN) if frame.span is not None else set())
        changed.append(frame)
    table.check_use(rows.values(), used)
    if idle := [table.columns[key] for key in SPAN if key in table.at and key not in used]:
        notes.append(f"{path.name}: {' and '.join(idle)} are not used, as the files hold temperatures by themselves")
    notes.append(f"{path.name} tells {', '.join(sorted(used)) or 'nothing'} of {len(rows)} of {len(frames)} frames")
    if unknown := [column for i, column in enumerate(table.table.columns) if column and i not in table.at.values()]:
        free = next((key for key in SPELLINGS if key not in table.at), "time")
        notes.append(
            f"{path.name}: columns {', '.join(unknown)} are not used; table_columns says what one holds, as in "
            f"table_columns.{free}={unknown[0]}"
        )
    return changed


def tells_spans(path: Path, columns: Mapping[str, str]) -> bool:
    """Whether a table has columns of the °C of black and white of each frame. Raises SceneError where it has one of the two."""
    table = FrameTable.read(path, columns)
    there = [key for key in SPAN if key in table.at]
    if len(there) == 1:
        lacking = next(key for key in SPAN if key not in there)
        raise SceneError(
            f"table={path} has a column {table.columns[there[0]]} and none {table.columns.get(lacking, lacking)}: the °C of "
            f"black and of white are needed; say which is which, as in table_columns.{lacking}={table.table.columns[-1]}"
        )
    return bool(there)


def spans_of(frames: Sequence[ThermalFrame], path: Path, columns: Mapping[str, str]) -> dict[str, ThermalRange]:
    """The °C of black and white of each frame, by its name; rows that are of no frame are warned of.

    Args:
        frames, path, columns: as of ``with_table``; the table tells spans.

    Raises:
        SceneError: a frame has no row or an empty one, or its two cells are no rising temperatures.
    """
    table = FrameTable.read(path, columns)
    rows = table.rows_of(frames)
    lower, upper = (table.at[key] for key in SPAN)
    known = {name: row for name, row in rows.items() if row[1][lower] or row[1][upper]}
    if lacking := [frame.path.name for frame in frames if frame.name not in known]:
        raise SceneError(
            f"table={path} has no {table.columns[LOWER]} and {table.columns[UPPER]} of {counted(len(lacking), 'frame')} of "
            f"{len(frames)}, such as {', '.join(lacking[:NAMED])}: add them, or take these files out of the source"
        )
    used = {line for line, _ in rows.values()}
    if idle := [cells[table.at["name"]] for line, cells in table.table.rows if line not in used]:
        log.warning(
            "%s: %s of no frame, such as %s: are these files missing, or called otherwise?",
            *(path, counted(len(idle), "row"), ", ".join(idle[:NAMED])),
        )
    return {name: span_in(table.table, line, cells[lower], cells[upper]) for name, (line, cells) in known.items()}


@dataclass(frozen=True)
class FrameTable:
    """A table with a column of names of files.

    Args:
        table: as it was read.
        columns: names of its columns by what they hold.
        at: positions of those that it has.
    """

    table: Table
    columns: Mapping[str, str]
    at: Mapping[str, int]

    @classmethod
    def read(cls, path: Path, columns: Mapping[str, str]) -> FrameTable:
        """The table in a file. Raises SceneError where it has no names of files, or nothing else that is known."""
        table = read_table(path)
        columns = {key: _column_of(key, column, table) for key, column in columns.items()}
        at = {key: table.columns.index(column) for key, column in columns.items() if column in table.columns}
        if "name" not in at:
            raise SceneError(
                f"table={path} has no column {columns.get('name')!r} with the names of files; it has "
                f"{', '.join(table.columns)}: set table_columns.name"
            )
        if not at.keys() - {"name"}:
            raise SceneError(
                f"table={path} has none of the columns {', '.join(c for k, c in columns.items() if k != 'name')}; "
                f"it has {', '.join(table.columns)}: say which is which, as in table_columns.time={table.columns[-1]}"
            )
        return cls(table, columns, at)

    def rows_of(self, frames: Sequence[ThermalFrame]) -> dict[str, Row]:
        """The rows by name of the frame that they belong to; a row names a file, or one of its frames, as flight_000003.

        Raises:
            SceneError: none belongs to a frame, or it cannot be told which does.
        """
        by_name = self._by_name()
        frames_in = Counter(frame.path for frame in frames)
        frame_files = [frame.path.with_name(f"{frame.path.stem}_{frame.number:06d}.tiff") for frame in frames]
        by_file = {}
        wanted = [
            path.as_posix() for frame, file in zip(frames, frame_files, strict=True) for path in (file, frame.path)
        ]
        for path, names in same_files(wanted, by_name).items():
            if len(names) > 1:
                raise SceneError(f"table={self.table.path}: {' and '.join(names)} may both be {path}; keep one of them")
            if names:
                by_file[path] = by_name[names[0]]
        rows: dict[str, Row] = {}
        for frame, file in zip(frames, frame_files, strict=True):
            several = frames_in[frame.path] > 1
            if several and file.as_posix() in by_file:
                rows[frame.name] = by_file[file.as_posix()]
            elif frame.path.as_posix() in by_file:
                line, cells = rows[frame.name] = by_file[frame.path.as_posix()]
                if several and self._cell(cells, "time"):
                    raise SceneError(
                        f"{self.table.path}, line {line}: {frame.path.name} holds {frames_in[frame.path]} frames, which have "
                        f"no time in common; give each a row, as {file.stem}"
                    )
        if not rows:
            raise SceneError(
                f"table={self.table.path} has no row for any of the {len(frames)} frames, such as {frames[0].path.name}; "
                f"its column {self.columns['name']} begins with {next(iter(by_name), 'nothing')}"
            )
        return rows

    def changes(self, frame: ThermalFrame, row: Row) -> tuple[dict[str, object], set[str]]:
        """Fields of a frame that its row changes, and which columns did. Raises SceneError for a cell that cannot be read."""
        line, cells = row
        changes: dict[str, object] = {}
        used: set[str] = set()
        if text := self._cell(cells, "time"):
            try:
                changes["time"] = datetime.fromisoformat(text)
            except ValueError as error:
                raise SceneError(
                    f"{self.table.path}, line {line}: {text!r} in column {self.columns['time']} is no date-time such as "
                    "2024-08-06T15:35:05.376"
                ) from error
            used.add("time")
        for field, kind in (("position", Position), ("attitude", Attitude)):
            numbers = {key: value for key in NUMBERS[kind] if (value := self._number(row, key)) is not None}
            if numbers.get("latitude_deg") == numbers.get("longitude_deg") == 0.0:
                raise SceneError(
                    f"{self.table.path}, line {line}: latitude and longitude are 0, as GPS without a fix has them; leave both "
                    "cells empty"
                )
            known = getattr(frame, field)
            if numbers and (known is not None or _needed(kind) <= numbers.keys()):
                changes[field] = kind(**numbers) if known is None else replace(known, **numbers)
                used.update(numbers)
        return changes, used

    def check_use(self, rows: Iterable[Row], used: set[str]) -> None:
        """Raises SceneError where a column has values in these rows and none was of use."""
        rows = list(rows)
        for kind, keys in NUMBERS.items():
            idle = [key for key in keys if key not in used and any(self._cell(cells, key) for _, cells in rows)]
            if idle:
                lacking = ", ".join(self.columns.get(key, key) for key in sorted(_needed(kind) - {idle[0]}))
                raise SceneError(
                    f"table={self.table.path}: column {self.columns[idle[0]]} changes nothing, as neither the table nor the "
                    f"files say {lacking} of the same frame; add that, or take the column away"
                )

    def _by_name(self) -> dict[str, Row]:
        rows: dict[str, Row] = {}
        for line, cells in self.table.rows:
            name = cells[self.at["name"]]
            if rows.setdefault(name, (line, cells))[1] != cells:
                raise SceneError(f"table={self.table.path}, line {line}: {name} has another row above; keep one")
        return rows

    def _cell(self, cells: Sequence[str], key: str) -> str:
        """What a row has in the column of ``key``; empty where the table has no such column."""
        return cells[self.at[key]] if key in self.at else ""

    def _number(self, row: Row, key: str) -> float | None:
        line, cells = row
        cell = self._cell(cells, key)
        if not cell:
            return None
        where = f"{self.table.path}, line {line}: {cell!r} in column {self.columns[key]}"
        try:
            value = self.table.number(cell)
        except ValueError as error:
            raise SceneError(f"{where} is no number") from error
        if not math.isfinite(value):
            raise SceneError(f"{where} is no number; leave cells empty of which nothing is known")
        if abs(value) > (most := MOST_DEG.get(key, math.inf)):
            raise SceneError(
                f"{where} is no {key.removesuffix('_deg')}, which lies between -{most:g} and {most:g} degrees"
            )
        return value


def _column_of(key: str, column: str, table: Table) -> str:
    """The column of ``key`` in a table: the one that is named, or another usual name of it that the table has.

    Raises:
        SceneError: the table has no column of a name that is none of the usual ones, or nothing can be read of ``key``.
    """
    if key not in SPELLINGS:
        raise SceneError(f"table_columns.{key}={column}: a table tells {', '.join(SPELLINGS)}, no {key}")
    usual = SPELLINGS[key]
    if column not in table.columns and column not in usual:
        raise SceneError(
            f"table={table.path} has no column {column!r}, as table_columns.{key} says; it has {', '.join(table.columns)}"
        )
    return next((name for name in (column, *usual) if name in table.columns), column)


def _needed(kind: type[Position | Attitude]) -> set[str]:
    """What cannot be left out of a position or an attitude."""
    return {part.name for part in fields(kind) if part.default is MISSING}
