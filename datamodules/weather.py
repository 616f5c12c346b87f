"""Weather records: checked, brought to one span of time without gaps, and with the sun added; and a scene under another one."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from heatsplat.contracts import RAIN, WEATHER_COLUMNS, Environment, SceneData, SceneError, View, ViewSet, Weather
from heatsplat.datamodules.side_files import finite, shortened
from heatsplat.datamodules.sun import Site, clear_sky, clouds, light_taken, split_irradiance, sun_directions
from heatsplat.datamodules.weather_table import (
    COVER,
    FALLEN,
    FIRST_EPOCH_S,
    OF_COVER,
    PYRANOMETER_OFFSET,
    QUANTITIES,
    read_columns,
    utc_text,
)

log = logging.getLogger(__name__)

# Longest time without a value that is bridged by a straight line, unless the configuration says otherwise.
MAX_GAP_S = 3 * 3600.0
# Share of a record from which it is worth a warning that a column which begins late or ends early shortens it.
CUT = 0.1
# The sun moves 2.5 degrees in this time; between samples all series are linear.
SUN_STEP_S = 600.0


def read_weather(
    path: Path, *, zone: str | None = None, site: Site | None = None, max_gap_s: float = MAX_GAP_S
) -> Weather:
    """The weather of a table, on its own clock: seconds since 1970 UTC, or the seconds that it gives.

    **Convention:** times are ISO 8601 with an offset (2024-07-11T06:00:00+02:00, ...Z), without one in ``zone``, or
    seconds; a column whose name ends in _utc needs no zone. Columns are separated by comma, semicolon, tab or bar;
    lines that begin with # are comments; empty cells, NaN and NA are missing.

    Args:
        path: the table.
        zone: of times without an offset: "UTC", "+02:00" or a name such as "Europe/Berlin"; None refuses them.
        site: where it was recorded; adds the sun's direction, direct and diffuse light, or None for neither.
        max_gap_s: longest gap that is interpolated.

    Raises:
        SceneError: it cannot be read, a value cannot be true, or a gap is too long. The message names line or column.
    """
    times, columns, notes = read_columns(path, zone)
    return make_weather(times, columns, site=site, max_gap_s=max_gap_s, source=str(path.name), notes=notes)


def make_weather(
    times_s: np.ndarray,
    columns: Mapping[str, np.ndarray],
    *,
    site: Site | None = None,
    max_gap_s: float = MAX_GAP_S,
    source: str = "the scene",
    notes: Mapping[str, Any] | None = None,
) -> Weather:
    """A checked record: sorted, without duplicates and gaps, with the sun where the place is known.

    Args:
        times_s: [T] seconds since 1970 UTC, or on the clock of the frames (below 1e8: then there is no sun).
        columns: values [T] by name in ``QUANTITIES``, NaN where missing.
        site, max_gap_s: as in ``read_weather``.
        source: what messages call it.
        notes: for the report, added to.

    Raises:
        SceneError: fewer than two samples, a value that cannot be true, or a gap that is too long.
    """
    notes = {"source": source, **(notes or {})}
    for name, values in columns.items():
        _check_range(name, values, times_s, source)
    times_s, columns, notes = _in_order(np.asarray(times_s, dtype=np.float64), columns, notes)
    columns = {name: values for name, values in columns.items() if np.isfinite(values).sum() >= 2}
    _check_shares(columns, source)
    _take_for_dry(columns, notes)
    if len(times_s) < 2 or not columns:
        raise SceneError(f"{source} holds no weather: two or more samples of at least one column are needed")
    times_s, columns = _common_span(times_s, columns, notes)
    columns = {name: _filled(name, times_s, values, max_gap_s, source, notes) for name, values in columns.items()}
    _complete(times_s, columns, source, notes)
    absolute = bool(times_s[0] >= FIRST_EPOCH_S)
    notes |= _notes_of(times_s, columns, absolute)
    sunlight: dict[str, np.ndarray] = {}
    if site is None or not absolute:
        what = "latitude and longitude are" if site is None else "the UTC of its times is"
        notes["sun"] = f"{what} not known: no direction of the sun, no direct and diffuse light"
    else:
        times_s, columns, sunlight = _with_sun(times_s, columns, site, source, notes)
    tensors = {name: torch.from_numpy(np.ascontiguousarray(v)) for name, v in {**columns, **sunlight}.items()}
    if site is not None:
        tensors["up"] = torch.from_numpy(site.axes()[2])
    return Weather(times_s=torch.from_numpy(times_s), notes=notes, **tensors)


def with_weather(scene: SceneData, path: Path, zone: str | None = None, max_gap_s: float = MAX_GAP_S) -> SceneData:
    """The scene under the weather of another table, for the same place; its images stay those of the old weather, and what is
    true under that is not known any more.

    Raises:
        SceneError: the scene has no weather to replace, or the table does not cover the times of its frames.
    """
    if scene.weather is None:
        raise SceneError(f"scene '{scene.name}' has no weather that weather={path} could replace")
    known = scene.weather.notes
    site = site_of(known)
    weather = read_weather(path, zone=zone, site=site, max_gap_s=max_gap_s)
    if ("utc_at_zero_s" in weather.notes) != ("utc_at_zero_s" in known):
        raise SceneError(
            f"weather={path} and scene '{scene.name}' do not share a clock: one has times of day, the other seconds; "
            "give the table times as the scene's own record has them"
        )
    weather = weather.since(known.get("utc_at_zero_s", known.get("clock_at_zero_s", 0.0)))

    def under(views: ViewSet) -> ViewSet:
        frames = [replace(f, environment=weather_at_frame(weather, f.name, f.time_s)) for f in views.frames]

        def decode(position: int) -> View:
            return replace(views[position], frame=frames[position])

        return ViewSet(frames, decode)

    notes = {**scene.notes, "weather_replaced_by": str(path)}
    views = {part: under(getattr(scene, part)) for part in ("train", "val", "test")}
    return replace(scene, weather=weather, truth=None, notes=notes, **views)


def weather_at_frame(weather: Weather, name: str, time_s: float) -> Environment:
    """The weather at the time of a frame. Raises SceneError naming the frame where the record does not reach it."""
    try:
        return weather.at(time_s)
    except SceneError as error:
        raise SceneError(f"frame {name}: {error}") from error


def site_of(notes: Mapping[str, Any]) -> Site | None:
    """The site that a record's notes name, or None."""
    if notes.get("latitude") is None or notes.get("longitude") is None:
        return None
    place = (
        finite(notes.get(key) or 0.0, f"data.{key} (or that of meta.json)")
        for key in ("latitude", "longitude", "altitude_m")
    )
    axes = {key: _axis(notes[key], key) for key in ("up", "north") if notes.get(key) is not None}
    return Site(*place, **axes)


def _axis(values: Any, key: str) -> tuple[float, ...]:
    if isinstance(values, str) or not isinstance(values, Sequence):
        raise SceneError(f"data.{key} (or that of meta.json) is {shortened(values)}, three numbers are needed")
    return tuple(finite(value, f"data.{key} (or that of meta.json)") for value in values)


def _check_range(name: str, values: np.ndarray, times_s: np.ndarray, source: str) -> None:
    quantity = QUANTITIES[name]
    wrong = (values < quantity.low) | (values > quantity.high)
    if wrong.any():
        first = int(np.argmax(wrong))
        low = max(quantity.low, 0.0) if name == "irradiance_w_m2" else quantity.low
        raise SceneError(
            f"{source}: {name} is {values[first]:.6g} at {_moment(times_s[first])} ({int(wrong.sum())} such values); it lies "
            f"between {low:g} and {quantity.high:g}. Check the column and its unit."
        )


def _check_shares(columns: Mapping[str, np.ndarray], source: str) -> None:
    """Raises SceneError where humidity is given as a share in place of per cent."""
    if "humidity_percent" in columns and 0 < (most := float(np.nanmax(columns["humidity_percent"]))) <= 1:
        raise SceneError(
            f"{source}: humidity_percent is {most:g} at the most, drier than any air. Shares are no per cent: name such a column "
            "humidity_fraction, or multiply by 100"
        )


def _take_for_dry(columns: dict[str, np.ndarray], notes: dict[str, Any]) -> None:
    """Fills rain with 0 where a record says nothing of it, as many do where none fell."""
    for name in (RAIN, FALLEN):
        if name in columns and (gaps := int(np.isnan(columns[name]).sum())):
            columns[name] = np.nan_to_num(columns[name])
            notes["dry"] = f"{gaps} samples without {name} are taken for dry"


def _notes_of(times_s: np.ndarray, columns: Mapping[str, np.ndarray], absolute: bool) -> dict[str, Any]:
    """What a record has and lacks, from when to when; ``absolute`` where its times are seconds since 1970 UTC."""
    notes: dict[str, Any] = {}
    if missing := [name for name in WEATHER_COLUMNS if name not in columns]:
        notes["missing"] = ", ".join(missing)
    if absolute:
        notes["utc_at_zero_s"] = 0.0
        notes["from_utc"], notes["to_utc"] = (utc_text(t) for t in (times_s[0], times_s[-1]))
    notes["span_h"] = round((times_s[-1] - times_s[0]) / 3600.0, 3)
    notes["step_min"] = round(float(np.median(np.diff(times_s))) / 60.0, 3)
    notes["ranges"] = {name: [round(float(v.min()), 2), round(float(v.max()), 2)] for name, v in columns.items()}
    return notes


def _in_order(
    times_s: np.ndarray, columns: Mapping[str, np.ndarray], notes: dict[str, Any]
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, Any]]:
    """Samples by time, those of one moment averaged."""
    if not np.isfinite(times_s).all():
        raise SceneError(f"{notes['source']}: a time is not finite")
    if (np.diff(times_s) < 0).any():
        notes["unsorted"] = "its samples were not in order of time and have been sorted"
    import pandas as pd  # here, for it takes long to load

    merged = pd.DataFrame(dict(columns), index=times_s).groupby(level=0).mean()
    if repeated := len(times_s) - len(merged):
        notes["duplicates"] = f"{repeated} samples repeat the time of another; those of one time are averaged"
    return merged.index.to_numpy(copy=True), {name: merged[name].to_numpy(copy=True) for name in merged}, notes


def _common_span(
    times_s: np.ndarray, columns: dict[str, np.ndarray], notes: dict[str, Any]
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The part of the record that all columns span, so that nothing is extrapolated."""
    ends = {name: np.flatnonzero(np.isfinite(values))[[0, -1]] for name, values in columns.items()}
    latest, earliest = max(ends, key=lambda name: ends[name][0]), min(ends, key=lambda name: ends[name][1])
    first, last = ends[latest][0], ends[earliest][1]
    if first >= last:
        raise SceneError(
            f"{notes['source']}: {latest} begins at {_moment(times_s[first])}, when {earliest} has ended "
            f"({_moment(times_s[last])}), so its columns have no span of time in common; leave one of them out"
        )
    if cut := len(times_s) - (last - first + 1):
        short = " and ".join(dict.fromkeys([latest] * bool(first > 0) + [earliest] * bool(last + 1 < len(times_s))))
        notes["cut"] = f"{cut} samples at the ends lack {short} and are left out"
        if cut > CUT * len(times_s):
            log.warning(
                "%s: %s; the record that remains runs from %s to %s. Without that column it would be longer",
                notes["source"], notes["cut"], _moment(times_s[first]), _moment(times_s[last]),
            )  # fmt: skip
    return times_s[first : last + 1], {name: values[first : last + 1] for name, values in columns.items()}


def _filled(
    name: str, times_s: np.ndarray, values: np.ndarray, max_gap_s: float, source: str, notes: dict[str, Any]
) -> np.ndarray:
    """A column without NaN. Raises SceneError where two of its samples lie further apart than ``max_gap_s``."""
    there = np.isfinite(values)
    gaps = np.diff(times_s[there])
    longest = int(gaps.argmax())
    if gaps[longest] > max_gap_s:
        raise SceneError(
            f"{source}: {name} has no value for {gaps[longest] / 3600:.3g} hours after "
            f"{_moment(times_s[there][longest])}, longer than the {max_gap_s / 3600:.3g} hours that are interpolated. Fill "
            "the gap, leave the column out, or allow it with weather_max_gap_h"
        )
    if not there.all():
        notes["gaps"] = {**notes.get("gaps", {}), name: f"{int((~there).sum())} values interpolated"}
    return np.interp(times_s, times_s[there], values[there])


def _complete(times_s: np.ndarray, columns: dict[str, np.ndarray], source: str, notes: dict[str, Any]) -> None:
    """Light by night is zero, and of cover and of what fell become what models know: light that clouds take, and rain."""
    if "irradiance_w_m2" in columns:
        below = columns["irradiance_w_m2"] < 0
        if below.any():
            notes["irradiance_offset"] = f"{int(below.sum())} values between {PYRANOMETER_OFFSET:g} and 0 W/m² set to 0"
            columns["irradiance_w_m2"] = columns["irradiance_w_m2"].clip(0.0)
    if COVER in columns:
        columns["clouds"] = light_taken(columns.pop(COVER))
        notes["clouds"] = OF_COVER
    if FALLEN in columns:
        if RAIN in columns:
            raise SceneError(f"{source} tells rain twice, as {RAIN} and as {FALLEN}; keep one")
        # Between samples the rate is linear: about each it lasts for half of the time to either neighbour, so that what falls in
        # all is what was measured, however uneven the samples are.
        hours = np.diff(times_s) / 3600.0
        before, after = np.concatenate([hours[:1], hours]), np.concatenate([hours, hours[-1:]])
        columns[RAIN] = columns.pop(FALLEN) / (0.5 * (before + after))
        notes["rain"] = "of what fell since the sample before"


def _with_sun(
    times_s: np.ndarray, columns: dict[str, np.ndarray], site: Site, source: str, notes: dict[str, Any]
) -> tuple[np.ndarray, dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The record on times that follow the sun, with its direction, direct and diffuse light."""
    pieces = np.maximum(np.ceil(np.diff(times_s) / SUN_STEP_S - 1e-9).astype(int), 1)
    fine = np.concatenate(
        [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(times_s, times_s[1:], pieces, strict=False)]
        + [times_s[-1:]]
    )
    if len(fine) > len(times_s):
        notes["resampled"] = (
            f"{len(times_s)} samples to {len(fine)}, at most {SUN_STEP_S / 60:g} minutes apart for the sun"
        )
    columns = {name: np.interp(fine, times_s, values) for name, values in columns.items()}
    sun = sun_directions(site, fine)
    height = np.degrees(np.arcsin((sun @ site.axes()[2]).clip(-1.0, 1.0)))
    measured = "irradiance_w_m2" in columns
    if measured:
        impossible = (height < -3.0) & (columns["irradiance_w_m2"] > 50.0)
        if impossible.any():
            first = int(np.argmax(impossible))
            raise SceneError(
                f"{source}: {columns['irradiance_w_m2'][first]:.0f} W/m² of sunlight at {_moment(fine[first])}, when the sun "
                f"is {-height[first]:.0f} degrees below the horizon of {site.latitude:g}, {site.longitude:g}. Check the "
                "time zone, latitude and longitude."
            )
        columns["irradiance_w_m2"] = np.where(height > 0, columns["irradiance_w_m2"], 0.0)
        notes["irradiance"] = "measured; direct and diffuse by the clearness of the sky (Erbs, Driesse)"
    else:
        columns["irradiance_w_m2"] = clear_sky(site, fine)
        notes["irradiance"] = "none in the record: that of a cloudless sky (Ineichen and Perez)"
        if "clouds" in columns:
            columns["irradiance_w_m2"] = columns["irradiance_w_m2"] * (1.0 - columns["clouds"])
            notes["irradiance"] = (
                "none in the record: that of a cloudless sky (Ineichen and Perez) less what its clouds take"
            )
    direct, diffuse = split_irradiance(site, fine, columns["irradiance_w_m2"])
    taken = None if "clouds" in columns or not measured else clouds(site, fine, columns["irradiance_w_m2"])
    if taken is not None:
        columns["clouds"] = taken
        notes["clouds"] = (
            "of the light that is missing to that of a clear sky, by night between dusk and dawn (Crawford, Duchon)"
        )
    notes["night_share"] = round(float((height <= 0).mean()), 3)
    if (height <= 0).all():
        notes["night_only"] = "the sun never rises in this record: it says nothing about how surfaces absorb sunlight"
        log.warning("%s: %s", source, notes["night_only"])
    notes |= {
        "latitude": site.latitude,
        "longitude": site.longitude,
        "altitude_m": site.altitude_m,
        "up": list(site.up),
        "north": list(site.north),
    }
    return fine, columns, {"direct_w_m2": direct, "diffuse_w_m2": diffuse, "sun": sun}


def _moment(seconds: float) -> str:
    return utc_text(seconds) if seconds >= FIRST_EPOCH_S else f"second {seconds:.6g}"
