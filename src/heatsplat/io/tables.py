"""Tables: Markdown for people, CSV for programs."""

from __future__ import annotations

import csv
import io
import math
import re
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from heatsplat.io.files import write_atomically

NONE = "–"

# By what they hold, columns of tables of frames as people and programs call them.
SPELLINGS = {
    "name": ("file", "name", "image"),
    "time": ("time",),
    "latitude_deg": ("latitude_deg", "latitude", "gps_lat", "lat"),
    "longitude_deg": ("longitude_deg", "longitude", "gps_lon", "lon"),
    "altitude_m": ("altitude_m", "altitude", "gps_alt", "alt"),
    "above_takeoff_m": ("above_takeoff_m", "height", "rel_alt"),
    "yaw_deg": ("yaw_deg", "yaw"),
    "pitch_deg": ("pitch_deg", "pitch"),
    "roll_deg": ("roll_deg", "roll"),
    "min_c": ("min_c",),
    "max_c": ("max_c",),
}


def number(value: float | None, digits: int, spread: float | None = None) -> str:
    """A number with separated thousands and its spread if there is one; a dash for None and NaN."""
    if value is None or math.isnan(value):
        return NONE
    text = f"{value:,.{digits}f}"
    return text if spread is None or math.isnan(spread) else f"{text} ± {spread:,.{digits}f}"


def over_seeds(values: Sequence[float], digits: int) -> str:
    """The mean of values and, of several, their standard deviation (n - 1); a dash for none."""
    if not values:
        return NONE
    return number(statistics.fmean(values), digits, statistics.stdev(values) if len(values) > 1 else None)


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[Any]], align: str = "") -> list[str]:
    """Lines of a Markdown table; bars within cells are escaped, and a cell is one line.

    Args:
        head: titles of the columns.
        rows: their cells.
        align: "l" or "r" for each column; "" puts all to the left.
    """
    rule = ["---:" if side == "r" else "---" for side in align or "l" * len(head)]
    lines = [_line(head), "|" + "|".join(rule) + "|"]
    return lines + [_line(row) for row in rows]


def _line(cells: Iterable[Any]) -> str:
    lines = (" ".join(str(cell).splitlines()) for cell in cells)
    return "| " + " | ".join(re.sub(r"(?<!\\)\|", r"\|", line) for line in lines) + " |"


def write_csv(path: Path | str, rows: Iterable[Mapping[str, Any]], columns: Sequence[str] | None = None) -> None:
    """Writes rows as CSV, as a whole or not at all: floats in full precision, None and what a row lacks empty.

    Args:
        path: of the file; infinity stands in it as ``inf``.
        rows: name of column -> value.
        columns: their order; None for the order in which they occur.
    """
    rows = list(rows)
    text = io.StringIO(newline="")
    writer = csv.DictWriter(
        text, columns or list(dict.fromkeys(key for row in rows for key in row)), lineterminator="\n"
    )
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(path, text.getvalue())


def read_csv(path: Path | str) -> list[dict[str, float | str | None]]:
    """Rows of a file that ``write_csv`` wrote, numbers as floats and empty cells as None.

    Raises:
        ValueError: a row has more cells than there are columns, as of two lines in one.
    """
    with open(path, newline="", encoding="utf-8") as file:
        rows = [*csv.DictReader(file)]
    if broken := next((number for number, row in enumerate(rows, 1) if None in row), None):
        raise ValueError(f"{path}: row {broken} has more cells than columns")
    return [{key: _value(text) for key, text in row.items()} for row in rows]


def _value(text: str) -> float | str | None:
    try:
        return float(text) if text else None
    except ValueError:
        return text
