"""Times of frames from file names and tables: pure functions to seconds (float64), on whatever clock the source has."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from datetime import UTC, datetime, tzinfo
from pathlib import Path, PurePosixPath
from zoneinfo import ZoneInfo

from heatsplat.contracts import SceneError, number_in
from heatsplat.datamodules.side_files import read_table
from heatsplat.physics.units import DAY_S

DJI_NAME = re.compile(r"DJI_(\d{14})_\d+_[A-Z]")


def instant(moment: datetime) -> float:
    """Seconds since 1970; a clock without a zone counts as UTC: only differences count, and they must not jump with daylight
    saving."""
    return (moment if moment.tzinfo else moment.replace(tzinfo=UTC)).timestamp()


def zone_of(name: str, key: str) -> tzinfo:
    """A time zone: UTC, +02:00 or Europe/Berlin. Raises SceneError for anything else, as the value of the setting ``key``."""
    try:
        if name[:1] in ("+", "-"):
            return datetime.fromisoformat(f"2000-01-01T00:00:00{name}").tzinfo
        return UTC if name.upper() in ("UTC", "Z") else ZoneInfo(name)
    except (ValueError, OSError, LookupError) as error:
        raise SceneError(f"{key}={name} is no time zone; give UTC, +02:00 or a name such as Europe/Berlin") from error


def seconds_of_day(digits: str) -> float:
    """Seconds since midnight of nine digits HHMMSSmmm. Raises ValueError when they are no time of day."""
    if not re.fullmatch(r"\d{9}", digits):
        raise ValueError(f"{digits!r} is not nine digits HHMMSSmmm")
    hours, minutes, seconds, thousandths = int(digits[:2]), int(digits[2:4]), int(digits[4:6]), int(digits[6:])
    if hours > 23 or minutes > 59 or seconds > 59:
        raise ValueError(f"{digits!r} is no time of day")
    return hours * 3600 + minutes * 60 + seconds + thousandths / 1000


def unrolled_midnight(times_s: Sequence[float]) -> tuple[list[float], bool]:
    """Times of day as times of one recording, and whether it passed midnight.

    Sorted names do not tell: a recording from 23:50 to 00:10 sorts as 00:10 .. 23:50. It passed midnight when the
    longest pause within the day is more than twice the pause across midnight; what lies before that pause is then the
    next day.
    """
    ordered = sorted(times_s)
    pauses = [b - a for a, b in zip(ordered, ordered[1:], strict=False)]
    if not pauses:
        return list(times_s), False
    longest = max(pauses)
    if longest <= 2 * (ordered[0] + DAY_S - ordered[-1]):
        return list(times_s), False
    last_of_next_day = ordered[pauses.index(longest)]
    return [t + DAY_S if t <= last_of_next_day else t for t in times_s], True


def is_of_day(form: str | None) -> bool:
    """Whether times that are written in a form of ``time_by_pattern`` begin anew every midnight."""
    return form is not None and (form == "HHMMSSmmm" or not set(re.findall(r"%([^%])", form)) - set("HIpMSfzZX"))


def dji_time(name: str) -> float | None:
    """Seconds of a DJI name such as DJI_20240806173449_0008_T.JPG (whole seconds, the camera's clock), or None."""
    match = DJI_NAME.search(PurePosixPath(name).name)
    try:
        return instant(datetime.strptime(match[1], "%Y%m%d%H%M%S")) if match else None
    except ValueError:  # fourteen digits that are no date
        return None


def time_by_pattern(name: str, regex: str, form: str | None) -> float:
    """Seconds from the part of a file name that a regular expression picks.

    Args:
        name: file name; its last component is searched.
        regex: expression whose first group is the time (the whole match without a group).
        form: strptime format of that part, "HHMMSSmmm" for nine digits of a time of day, or None for seconds.

    Raises:
        SceneError: the name does not match or the part is no time.
    """
    match = re.search(regex, PurePosixPath(name).name)
    if match is None:
        raise SceneError(f"data.time_regex {regex!r} does not match the image name {name}")
    part = match[1] if match.re.groups else match[0]
    try:
        return number_in(part) if form is None else _of_form(part, form)
    except ValueError as error:
        raise SceneError(f"image name {name}: {part!r} is no time of the form {form or 'seconds'} ({error})") from error


def _of_form(text: str, form: str) -> float:
    """Seconds of a time that is written in a form of ``time_by_pattern``. Raises ValueError for other text."""
    return seconds_of_day(text) if form == "HHMMSSmmm" else instant(datetime.strptime(text, form))


def times_from_csv(path: Path, name_column: str, time_column: str, form: str | None = None) -> dict[str, float]:
    """Seconds by file, named as in the table; the time column holds seconds or ISO 8601 date-times, or times of a form.

    Args:
        path: of the table.
        name_column, time_column: its columns.
        form: strptime format of the times, or "HHMMSSmmm"; None for seconds and ISO 8601 date-times.

    Raises:
        SceneError: no such column, a cell that is no such time, times of several clocks, or two times of one file.
    """
    table = read_table(path)
    for key, column in (("time_csv_name", name_column), ("time_csv_time", time_column)):
        if column not in table.columns:
            raise SceneError(f"data.{key}={column}: {path} has no such column; it has {', '.join(table.columns)}")
    name_at, time_at = table.columns.index(name_column), table.columns.index(time_column)
    times: dict[str, float] = {}
    clocks: dict[str, tuple[int, str]] = {}
    for number, row in table.rows:
        cell = row[time_at]
        try:
            seconds = seconds_of(table.pointed(cell)) if form is None else _of_form(cell, form)
            if not math.isfinite(seconds):
                raise ValueError(cell)
        except ValueError as error:
            what = f"no time of the form {form} (data.time_format; null takes seconds and ISO date-times)"
            if form is None:
                what = (
                    "neither seconds nor a date-time such as 2024-08-06T15:35:05.376; how others are written says "
                    "\"data.time_format='%d.%m.%Y %H:%M:%S'\" or data.time_format=%H:%M:%S"
                )
            raise SceneError(f"{path}, line {number}: {cell!r} in column {time_column} is {what}") from error
        clocks.setdefault(_clock(table.pointed(cell)) if form is None else "", (number, cell))
        if len(clocks) > 1:
            (first, (above, earlier)), (second, _) = clocks.items()
            raise SceneError(
                f"{path}, line {number}: {cell!r} in column {time_column} is {second}, and {earlier!r} in line {above} is "
                f"{first}; hours may lie between the two: write all alike"
            )
        if times.setdefault(row[name_at], seconds) != seconds:
            raise SceneError(
                f"{path}, line {number}: {row[name_at]} has another time in a line above; keep one of them"
            )
    return times


def _clock(text: str) -> str:
    """What a time of ``seconds_of`` counts on, in words."""
    try:
        number_in(text)
    except ValueError:
        return f"a date-time {'with' if datetime.fromisoformat(text).tzinfo else 'without'} a time zone"
    return "a number of seconds"


def seconds_of(text: str) -> float:
    """Seconds, or those of an ISO date-time since 1970. Raises ValueError for anything else."""
    try:
        return number_in(text)
    except ValueError:
        return instant(datetime.fromisoformat(text))
