"""Temperatures as text: the table of an image's pixels that programs of cameras export, such as FLIR Tools."""

from __future__ import annotations

import csv
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from heatsplat.contracts import SceneError, number_in
from heatsplat.datamodules.side_files import says_fahrenheit

SUFFIX = ".csv"
MIN_SIDE = 16  # pixels: smaller tables are no images
SEPARATORS = ("\t", ";", ",")


def read_temperature_table(path: Path) -> np.ndarray | None:
    """The numbers [H, W] float32 of an image that was exported as text; None where a file holds no such table.

    Lines may stand before and after the table, and its first row and column may count pixels, which are left out. Cells stand
    between tabs, semicolons (both with decimal commas or points) or commas (with decimal commas in quotes); those without a
    number are NaN.

    Raises:
        SceneError: the file cannot be read, holds several images, or says that its numbers are °F.
    """
    lines = _text(path).splitlines()
    tables, separator = max(
        ((list(_tables(lines, one)), one) for one in SEPARATORS),
        key=lambda found: max((table.size for _, table in found[0]), default=0),
    )
    if not tables:
        return None
    first, table = max(tables, key=lambda found: found[1].size)
    if sum(other.shape == table.shape for _, other in tables) > 1:
        raise SceneError(f"{path} holds several images as tables: export each into a file of its own")
    around = lines[:first] + lines[first + len(table) :]
    if any(says_fahrenheit(line) for line in around):
        raise SceneError(
            f"{path} says that its temperatures are °F: export them in °C, or write (F - 32) / 1.8 for each"
        )
    return _without_counts(table)


def _text(path: Path) -> str:
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}") from error
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return data.decode("utf-16", errors="replace")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:  # as Windows writes degrees
        return data.decode("cp1252", errors="replace")


def _tables(lines: list[str], separator: str) -> Iterator[tuple[int, np.ndarray]]:
    """The runs of lines with equally many numbers, as the number of the first line and [H, W] float32."""
    start, rows = 0, []
    for number, line in enumerate([*lines, ""]):
        row = _numbers(line, separator)
        if rows and len(row) != len(rows[0]):
            if len(rows) >= MIN_SIDE and not _is_of_records(rows):
                yield start, np.array(rows, np.float32)
            rows = []
        if row:
            start = start if rows else number
            rows.append(row)


def _is_of_records(rows: list[list[float | None]]) -> bool:
    """Whether a column has words in most rows, such as the times of a weather record."""
    words = Counter(column for row in rows if None in row for column, cell in enumerate(row) if cell is None)
    return bool(words) and 2 * max(words.values()) > len(rows)


def _numbers(line: str, separator: str) -> list[float | None]:
    """The numbers of a line, NaN for an empty cell and None for one with words; none where it has fewer than ``MIN_SIDE`` cells,
    or half are words."""
    if '"' not in line:
        cells = (line if separator == "," else line.replace(",", ".")).split(separator)
        if len(cells) < MIN_SIDE:
            return []
        try:
            return [*map(float, cells)]  # as most rows are: quicker than cell by cell
        except ValueError:
            if 2 * sum(";" in cell for cell in cells) >= len(cells):  # these commas are decimal ones
                return []
    else:  # around cells with a decimal comma, where commas separate these
        try:
            cells = next(csv.reader([line], delimiter=separator))
        except csv.Error:
            return []
        cells = [cell.replace(",", ".").replace('"', "") for cell in cells]
    if len(cells) > MIN_SIDE and not cells[-1].strip():  # rows may end, and begin, with a separator
        cells.pop()
    if len(cells) > MIN_SIDE and not cells[0].strip():
        cells.pop(0)
    if len(cells) < MIN_SIDE or not any(cells):
        return []
    found = [_number(cell.strip() or "nan") for cell in cells]
    return [] if 2 * found.count(None) >= len(found) else found


def _number(cell: str) -> float | None:
    """The number in a cell; None where it is none, as of a pixel that is too hot (">150")."""
    try:
        return number_in(cell)
    except ValueError:
        return None


def _without_counts(table: np.ndarray) -> np.ndarray:
    """The table without a first row and a first column that count pixels, from 0 or 1."""
    if _counts(table[1:, 0]):
        table = table[:, 1:]
    if _counts(table[0]):
        table = table[1:]
    return np.ascontiguousarray(table)


def _counts(values: np.ndarray) -> bool:
    return values[0] in (0, 1) and bool((np.diff(values) == 1).all())
