"""Tables of the weather as people and programs write them: which column is which quantity, in which unit, at which times.

A table has a column of times and any of the quantities, each with its unit at the end of its name: ``air_c``, ``air_k``,
``air_f``; ``wind_m_s``, ``wind_km_h``, ``wind_kn``; ``humidity_percent``; ``irradiance_w_m2``; ``pressure_hpa``,
``pressure_pa``; ``cloud_cover_percent``, ``cloud_cover_oktas``; ``rain_mm_h``, or ``rain_mm`` since the sample before. Names as
people write them are understood ("Air temperature [°C]", "GHI (W/m²)").
"""

from __future__ import annotations

import csv
import logging
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from heatsplat.contracts import RAIN, WEATHER_COLUMNS, SceneError, Weather, number_in
from heatsplat.datamodules.side_files import read_table
from heatsplat.datamodules.sun import cover_of
from heatsplat.datamodules.timestamps import zone_of

log = logging.getLogger(__name__)

# What an unlit pyranometer may read, in W/m²; below it the column is something else.
PYRANOMETER_OFFSET = -5.0
# Numbers from here on are seconds since 1970, below it seconds on the clock of the frames.
FIRST_EPOCH_S = 1e8
LAST_EPOCH_S = 9e9  # in the year 2255; milliseconds since 1970 are more
MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--"}


@dataclass(frozen=True)
class Quantity:
    """A column of the weather: how it may be called, its units as (scale, offset) to ours, and what can be true."""

    aliases: tuple[str, ...]
    units: Mapping[str, tuple[float, float]]
    low: float
    high: float


FALLEN = "rain_mm"  # since the sample before, of which RAIN follows
RAIN_NAMES = ("rain", "precipitation", "precip", "rainfall", "total_precipitation")
COVER = "cloud_cover"  # share of the sky that clouds take, of which light that they take follows (Weather.clouds)
OF_COVER = "of the cover in the record (Kasten and Czeplak)"  # what a record notes of such clouds
QUANTITIES: dict[str, Quantity] = {
    "air_c": Quantity(
        ("air", "air_temperature", "temperature", "temp", "t_air", "t2m", "temperature_2m"),
        {"c": (1.0, 0.0), "k": (1.0, -273.15), "f": (5.0 / 9.0, -160.0 / 9.0)},
        -90.0,
        60.0,
    ),
    "wind_m_s": Quantity(
        ("wind", "wind_speed", "windspeed", "wind_speed_10m"),
        {"m_s": (1.0, 0.0), "km_h": (1 / 3.6, 0.0), "kmh": (1 / 3.6, 0.0), "kn": (0.514444, 0.0), "mph": (0.44704, 0.0)},
        0.0,
        110.0,
    ),
    "humidity_percent": Quantity(
        ("humidity", "relative_humidity", "rh", "relative_humidity_2m"),
        {"percent": (1.0, 0.0), "pct": (1.0, 0.0), "fraction": (100.0, 0.0)},
        0.0,
        100.0,
    ),
    "irradiance_w_m2": Quantity(
        ("irradiance", "ghi", "global_horizontal", "global_irradiance", "solar", "solar_radiation", "shortwave_radiation"),
        {"w_m2": (1.0, 0.0), "kw_m2": (1000.0, 0.0)},
        PYRANOMETER_OFFSET,
        1600.0,
    ),
    "pressure_hpa": Quantity(
        ("pressure", "air_pressure", "surface_pressure"),
        {"hpa": (1.0, 0.0), "mbar": (1.0, 0.0), "kpa": (10.0, 0.0), "pa": (0.01, 0.0)},
        300.0,
        1100.0,
    ),
    COVER: Quantity(
        ("cloud_cover", "cloudcover", "clouds", "total_cloud_cover"),
        {"fraction": (1.0, 0.0), "percent": (0.01, 0.0), "pct": (0.01, 0.0), "oktas": (0.125, 0.0), "octas": (0.125, 0.0)},
        0.0,
        1.0,
    ),
    RAIN: Quantity(RAIN_NAMES, {"mm_h": (1.0, 0.0), "in_h": (25.4, 0.0), "kg_m2_s": (3600.0, 0.0)}, 0.0, 500.0),
    FALLEN: Quantity(RAIN_NAMES, {"mm": (1.0, 0.0), "in": (25.4, 0.0)}, 0.0, 500.0),
}  # fmt: skip
# Units as programs write them, by what they are above.
SPELLINGS = {
    spelling: unit
    for unit, spellings in {
        "c": ("degc", "deg_c", "degrees_c", "celsius", "deg_celsius", "degrees_celsius"),
        "f": ("degf", "deg_f", "degrees_f", "fahrenheit"),
        "k": ("kelvin", "degk"),
        "m_s": ("ms", "mps", "m_sec", "meters_per_second", "metres_per_second"),
        "km_h": ("kph", "km_hr"),
        "kn": ("kt", "kts", "knot", "knots"),
        "w_m2": ("wm2", "w_per_m2", "watts_m2"),
        "kw_m2": ("kwm2",),
        "mbar": ("mb", "millibar"),
        "mm_h": ("mm_hr", "mmh"),
    }.items()
    for spelling in spellings
}
TIME_NAMES = ("time", "utc", "time_utc", "timestamp", "timestamp_utc", "datetime", "datetime_utc", "date", "date_time",
              "time_s", "epoch_s", "unix_s", "seconds")  # fmt: skip


def read_columns(path: Path, zone: str | None) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, Any]]:
    """Times [T], columns [T] by name (NaN where missing) and notes of a table, unsorted.

    Times are float64 seconds, since 1970 UTC where they are dates, else on the clock of the table; columns have the units of
    ``QUANTITIES``.

    Args:
        path: of the table.
        zone: of its times where they have no offset (``utc_seconds``).

    Raises:
        SceneError: there is no such table, it has no times or none of the quantities, or a cell cannot be read.
    """
    if not path.is_file():
        raise SceneError(f"there is no weather table {path}")
    table = read_table(path, lambda cells: any(_plain(cell) in TIME_NAMES for cell in cells))
    if len(table.rows) < 2:
        raise SceneError(f"{path} holds no weather: a line of column names and two or more samples are needed")
    header = table.columns
    time_at = _time_column(header, path)
    wanted, unused = _columns_of(header, time_at, path)
    own_zone = "UTC" if _plain(header[time_at]).endswith("utc") else zone

    def seconds_in(number: int, cells: Sequence[str], after: float | None = None) -> float:
        where = f"{path}, line {number}, column {header[time_at]}"
        return utc_seconds(table.pointed(cells[time_at]), own_zone, where, after)

    # Tables with the newest row first are read from their end, so that of an hour that clocks show twice the earlier comes first.
    backwards = seconds_in(*table.rows[0]) > seconds_in(*table.rows[-1])
    times, values = [], {name: [] for name in wanted}
    for number, cells in table.rows[:: -1 if backwards else 1]:
        times.append(seconds_in(number, cells, times[-1] if times else None))
        for name, (position, (scale, offset)) in wanted.items():
            cell = cells[position]
            if cell.lower() in MISSING:
                values[name].append(np.nan)
                continue
            try:
                values[name].append(scale * table.number(cell) + offset)
            except ValueError as error:
                raise SceneError(
                    f"{path}, line {number}: {cell!r} in column {header[position]} is no number"
                ) from error
    seconds = np.array(times)
    kinds = set((seconds >= FIRST_EPOCH_S).tolist())
    if len(kinds) > 1:
        raise SceneError(
            f"{path}: some times are seconds since 1970 or dates, others count from elsewhere; use one clock"
        )
    notes: dict[str, Any] = {"unused_columns": ", ".join(unused)} if unused else {}
    return seconds, {name: np.array(v) for name, v in values.items()}, notes


def _time_column(header: Sequence[str], path: Path) -> int:
    plain = [_plain(name) for name in header]
    place = next((plain.index(name) for name in TIME_NAMES if name in plain), None)
    if place is None:
        raise SceneError(
            f"{path} has no column of times ({', '.join(TIME_NAMES[:4])}, time_s, ...); it has {', '.join(header)}"
        )
    return place


def _columns_of(
    header: Sequence[str], time_at: int, path: Path
) -> tuple[dict[str, tuple[int, tuple[float, float]]], list[str]]:
    """Place and unit of each quantity in a table, and names of columns that are none; warns of those that may be meant to be."""
    wanted: dict[str, tuple[int, tuple[float, float]]] = {}
    unused = []
    for position, name in enumerate(header):
        if position == time_at:
            continue
        try:
            found = _quantity(name)
        except ValueError as error:
            raise SceneError(f"{path}: column {name!r} {error}") from error
        if found is None:
            unused.append(name)
            continue
        quantity, unit = found
        if quantity in wanted:
            raise SceneError(f"{path}: {header[wanted[quantity][0]]!r} and {name!r} are both {quantity}; keep one")
        wanted[quantity] = position, unit
    if not wanted:
        raise SceneError(f"{path} has none of the columns {', '.join(QUANTITIES)}; it has {', '.join(header)}")
    for name in unused:
        if (quantity := _like(name)) is not None and quantity not in wanted:
            log.warning("%s: column %r is not used; if it is %s in another unit, call it that", path, name, quantity)
    return wanted, unused


def write_weather(path: Path, weather: Weather) -> None:
    """Writes a record as a table that ``read_weather`` reads: ISO times in UTC where it knows them, else seconds.

    Clouds are written where they were recorded; those that light tells of are told again by the light in the table.
    """
    zero = weather.notes.get("utc_at_zero_s")
    columns = {name: getattr(weather, name) for name in (*WEATHER_COLUMNS, RAIN)}
    if weather.notes.get("clouds") == OF_COVER:
        columns[f"{COVER}_percent"] = 100.0 * cover_of(weather.clouds.numpy())
    columns = {name: series for name, series in columns.items() if series is not None}
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time_s" if zero is None else "utc", *columns])
        for i, time in enumerate(weather.times_s.tolist()):
            moment = repr(time) if zero is None else utc_text(zero + time)
            rows.writerow([moment, *(f"{series[i].item():.10g}" for series in columns.values())])


def utc_text(seconds: float) -> str:
    """ISO date-time in UTC of seconds since 1970."""
    return datetime.fromtimestamp(float(seconds), UTC).isoformat()


def utc_seconds(text: str | float, zone: str | None, where: str, after: float | None = None) -> float:
    """Seconds since 1970 UTC of an ISO date-time, or a number as it is.

    Args:
        text: the date-time, or the number.
        zone: of a date-time without an offset.
        where: it stands, for messages.
        after: the time in the row before, or None. Of an hour that clocks show twice, as summer time ends, it is the second
            where the first would not come after that.

    Raises:
        SceneError: it is neither, or beyond the year 2255, or it has no offset and ``zone`` is None; ``where`` is named.
    """
    try:
        number = number_in(text) if isinstance(text, str) else float(text)
    except (ValueError, TypeError, OverflowError):
        pass
    else:
        if LAST_EPOCH_S < number < math.inf:
            raise SceneError(f"{where}: {text} lies beyond the year 2255; divide milliseconds since 1970 by 1000")
        return number
    try:
        moment = datetime.fromisoformat(str(text).strip())
    except ValueError as error:
        raise SceneError(
            f"{where}: {text!r} is neither seconds nor a date-time such as 2024-07-11T06:00:00Z"
        ) from error
    if moment.tzinfo is None:
        if zone is None:
            raise SceneError(
                f"{where}: {text!r} has no time zone. Write an offset (Z, +02:00) into the times, or say in which zone "
                "they are: weather_zone=UTC, +02:00 or Europe/Berlin"
            )
        moment = moment.replace(tzinfo=zone_of(zone, "weather_zone"))
        again = moment.replace(fold=1)
        if after is not None and moment.timestamp() <= after < again.timestamp():
            moment = again
    return moment.timestamp()


def _plain(name: str) -> str:
    """A column name as letters, digits and single underscores: "Wind (km/h)" is wind_km_h."""
    text = (
        name.strip()
        .lower()
        .replace("⁻", "-")
        .replace("¹", "1")
        .replace("²", "2")
        .replace("%", "percent")
        .replace("°", "")
        .replace("m-2", "m2")
        .replace("s-1", "s")
        .replace("^", "")
    )
    return re.sub(r"[^a-z0-9]+", "_", text).strip("_")


def _quantity(header: str) -> tuple[str, tuple[float, float]] | None:
    """Which column of the weather a name means, and its unit; None for something else.

    Raises:
        ValueError: it has no unit, or one in brackets that is none of the quantity's.
    """
    plain = _plain(header)
    named, bracket, _ = header.partition("[") if "[" in header else header.partition("(")
    for name, quantity in QUANTITIES.items():
        for alias in quantity.aliases:
            unit = plain[len(alias) + 1 :]
            unit = SPELLINGS.get(unit, unit)
            if plain.startswith(alias + "_") and unit in quantity.units:
                return name, quantity.units[unit]
    for quantity in QUANTITIES.values():
        for alias in quantity.aliases:
            if plain == alias or (bracket and _plain(named) == alias):
                units = ", ".join(f"{alias}_{unit}" for unit in quantity.units)
                raise ValueError(f"has {'no unit' if plain == alias else 'an unknown unit'}; name it one of {units}")
    return None


def _like(header: str) -> str | None:
    """The quantity that a column may be meant to be that was not understood: its name begins as that one's does."""
    plain = _plain(header)
    begin = {alias: name for name, quantity in QUANTITIES.items() for alias in quantity.aliases}
    return next((begin[alias] for alias in sorted(begin, key=len) if plain.startswith(alias + "_")), None)
