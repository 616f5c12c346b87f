"""Small files beside the images, as people and programs write them (``contracts.text_in``): JSON, tables, lists of names."""

from __future__ import annotations

import csv
import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneError, number_in, table_lines, text_in


def _named(word: str, letter: str) -> re.Pattern[str]:
    """How programs name a unit beside numbers: in words, or by its letter where a unit is told (text, JSON, GDAL's metadata)."""
    return re.compile(
        rf"°\s*{letter}\b|\bdeg(?:rees?)?[\s_]*{letter}\b|\b{word}\b|units?[\"']?\s*[=:]\s*[\"']?{letter}\b(?![-/])|"
        rf"unittype\"[^<>]*>\s*{letter}\b",
        re.IGNORECASE,
    )


FAHRENHEIT, KELVIN = _named("fahrenheit", "F"), _named("kelvins?", "K")


def found_file(key: str, path: str | Path, folder: Path | None) -> Path:
    """The file that a setting of the data names: in the folder of the scene, else in the working directory.

    Args:
        key: the setting, such as "data.time_csv", for the message.
        path: its value.
        folder: of the scene; None where it has none.

    Raises:
        SceneError: it is in neither, with both.
    """
    path = Path(path).expanduser()
    places = [place.absolute() / path for place in (folder, Path()) if place is not None]
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        told = " and no ".join(dict.fromkeys(str(place) for place in places))
        raise SceneError(f"{key}={path}: there is no file {told}")
    return found


def read_text(path: Path) -> str:
    """Content of a text file. Raises SceneError when it cannot be read."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise SceneError(f"{path} cannot be read: {error.strerror}") from error
    try:
        return text_in(data)
    except ValueError as error:
        raise SceneError(f"{path} is no text file; save it as UTF-8") from error


def read_json(path: Path) -> Any:
    """Content of a JSON file. Raises SceneError naming it when it cannot be parsed."""
    try:
        return json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{path} is not readable JSON: {error}") from error


def json_object(path: Path) -> dict[str, Any]:
    """Content of a JSON file that holds keys and values. Raises SceneError when it holds anything else."""
    return mapping(read_json(path), str(path))


def mapping(values: Any, where: str) -> dict[str, Any]:
    """Keys and values, none for None. Raises SceneError naming ``where`` for anything else."""
    if not isinstance(values, dict | None):
        raise SceneError(f"{where} must hold keys and values in braces {{...}}, it holds {shortened(values)}")
    return values or {}


def finite(value: Any, where: str, what: str = "a number") -> float:
    """A number, which may stand in quotes, with a point or a comma. Raises SceneError, naming ``where``, for all else."""
    try:
        if isinstance(value, bool):
            raise TypeError
        number = number_in(value.replace(",", ".")) if isinstance(value, str) else float(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise SceneError(f"{where} is {shortened(value)}, {what} is needed") from error
    if not math.isfinite(number):
        raise SceneError(f"{where} is {number}, {what} is needed")
    return number


def says_fahrenheit(text: str) -> bool:
    """Whether text beside numbers says that they are °F."""
    return FAHRENHEIT.search(text) is not None


def says_kelvin(text: str) -> bool:
    """Whether text beside numbers says that they are kelvin; it may mean differences, such as a resolution."""
    return KELVIN.search(text) is not None


def shortened(value: Any, most: int = 60) -> str:
    """``repr`` of a value for messages, cut where it is long."""
    text = repr(value)
    return text if len(text) <= most else text[:most] + "..."


@dataclass(frozen=True)
class Table:
    """A table: names of its columns, and each row as (number of its line, one cell per column)."""

    path: Path
    columns: list[str]
    rows: list[tuple[int, list[str]]]
    decimal_comma: bool

    def number(self, cell: str) -> float:
        """The number in a cell. Raises ValueError when it is none."""
        return number_in(self.pointed(cell))

    def pointed(self, cell: str) -> str:
        """The cell with a decimal point."""
        return cell.replace(",", ".") if self.decimal_comma else cell


def read_table(path: Path, names_columns: Callable[[list[str]], bool] | None = None, comments: bool = True) -> Table:
    """A table with a line of column names.

    **Convention:** columns are separated by comma, semicolon, tab or bar, whichever that line has most of; only
    where they are not separated by commas may a number have a decimal comma. Lines that begin with #, empty ones, and
    Excel's line "sep=;" are skipped.

    Args:
        path: of the table.
        names_columns: whether the cells of a line are names of columns: what stands before the first such line, as programs say
            where and when they measured, is skipped. None, and where there is no such line, for the first one.
        comments: whether lines that begin with # are skipped; False where a name may begin so.

    Raises:
        SceneError: it cannot be read, or a row has fewer or more cells than there are columns; the message names the line.
    """
    lines = table_lines(read_text(path), comments)
    if not lines:
        raise SceneError(f"{path} is empty; a line of column names and rows below it are needed")

    def delimiter_of(line: str) -> str:
        return max(",;\t|", key=line.count)

    def cells(line: str, delimiter: str) -> list[str]:
        try:
            return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter))]
        except csv.Error as error:
            raise SceneError(f"{path}: {shortened(line)} is no row of a table ({error})") from error

    named = (i for i, (_, line) in enumerate(lines) if names_columns and names_columns(cells(line, delimiter_of(line))))
    first = next(named, 0)
    delimiter = delimiter_of(lines[first][1])
    columns = cells(lines[first][1], delimiter)
    rows = [(number, row) for number, line in lines[first + 1 :] if any(row := cells(line, delimiter))]
    for number, row in rows:
        if len(row) < len(columns):
            raise SceneError(f"{path}, line {number}: {len(row)} cells for {len(columns)} columns")
        if any(row[len(columns) :]):  # 19,5 between commas is two cells, and all behind it stand in the wrong column
            raise SceneError(
                f"{path}, line {number}: {len(row)} cells for {len(columns)} columns; separate columns by semicolons where "
                "numbers have decimal commas, and put text that holds a separator into quotes"
            )
    return Table(path, columns, rows, decimal_comma=delimiter != ",")
