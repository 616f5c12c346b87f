"""What is wrong with a setting or with input data, and checks that say so. Imports nothing heavy: every command begins here."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from numbers import Real
from typing import Any


class SceneError(ValueError):
    """Input data that cannot be used as it is. The message names the file, key or shape and the remedy."""


def check_option(name: str, value: Any, known: Iterable[Any], error: type[ValueError] = ValueError) -> None:
    """Raises ``error``, with the values that are known, where an option has another one."""
    if value not in known:
        shown = as_written(value) if value is None or isinstance(value, bool) else f"'{as_written(value)}'"
        raise error(f"{name} must be one of {', '.join(map(as_written, known))}, got {shown}")


def as_written(value: Any) -> str:
    """A setting for messages, as a configuration and the command line have it: null and true, not None and True."""
    if value is None or isinstance(value, bool):
        return "null" if value is None else str(value).lower()
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{key}: {as_written(one)}' for key, one in value.items())}}}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(as_written, value))}]"
    return str(value)


def check_numbers(
    name: str,
    value: Any,
    count: int | None = None,
    error: type[ValueError] = ValueError,
    above: float = -math.inf,
) -> None:
    """Raises ``error`` where a setting is no finite number ``above`` another, or with ``count`` no list of so many."""
    listed = isinstance(value, Sequence) and not isinstance(value, str)
    numbers = value if listed else [value]
    shown = as_written(value)
    if not all(is_number(x) for x in numbers) or (count is None) == listed or (listed and len(numbers) != count):
        wanted = "a number" if count is None else f"a list of {count} numbers"
        raise error(f"{name} must be {wanted}, got {shown}")
    if not all(x > above for x in numbers):
        raise error(f"{name} must be above {above:g}, got {shown}")


def check_count(name: str, value: Any, least: int = 1) -> None:
    """Raises SceneError where an option is no whole number, or less than ``least``."""
    if not isinstance(value, int) or isinstance(value, bool) or value < least:
        raise SceneError(f"{name} must be a whole number, {least} or more, got {as_written(value)}")


def number_in(text: str) -> float:
    """The number that a text is. Raises ValueError for anything else, as for 1_5, which Python takes for 15."""
    if "_" in text:
        raise ValueError(f"could not convert string to float: {text!r}")
    return float(text)


def text_in(data: bytes) -> str:
    """Text as people and their programs save it: UTF-8 with or without a byte order mark, UTF-16 with one, or else Windows' own
    encoding (Excel writes all four). Raises ValueError where it is none of them."""
    marked = data[:2] in (b"\xff\xfe", b"\xfe\xff")
    for encoding in ["utf-16"] if marked else ["utf-8-sig", "cp1252"]:
        try:
            return data.decode(encoding)
        except UnicodeDecodeError:
            continue
    raise ValueError("it is no text; save it as UTF-8")


def table_lines(text: str, comments: bool = True) -> list[tuple[int, str]]:
    """Number, from 1 on, and text of the lines of a table: without empty ones, Excel's "sep=;", and with ``comments`` those that
    begin with #."""
    return [
        (number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not (comments and line.lstrip().startswith("#")) and not re.fullmatch(r"\s*sep=.\s*", line)
    ]


def counted(number: int, what: str) -> str:
    """A number with its noun for messages: "1 frame", "10 frames"."""
    return f"{number} {what}{'' if number == 1 else 's'}"


def rounded(value: float, digits: int) -> str:
    """A number for messages, of so many significant digits, without powers of ten where it is large: "130", not "1.3e+02"."""
    short = f"{value:.{digits}g}"
    return f"{float(short):,.0f}" if abs(float(short)) >= 10**digits else short


def is_number(value: Any) -> bool:
    """Whether a setting is a finite number: neither text nor true or false."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
