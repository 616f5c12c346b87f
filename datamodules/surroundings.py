"""What files beside the images tell of a scene: the weather of its record, the classes and features of its points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from heatsplat.contracts import WEATHER_COLUMNS, Environment, SceneError, Weather
from heatsplat.datamodules.base import RawFrame, SceneDataModule
from heatsplat.datamodules.side_files import finite, mapping
from heatsplat.datamodules.weather import make_weather, read_weather, site_of

WEATHER_FILE, LABELS_FILE, FEATURES_FILE = "weather.csv", "labels.npy", "space_features.npy"


@dataclass(frozen=True)
class Surroundings:
    """Options of loaders whose scenes have weather. Files are relative to the scene.

    Args:
        weather: table of the weather (``heatsplat.datamodules.weather_table``), or None for none; weather.csv may be absent.
        zone: time zone of its times where they have no offset.
        max_gap_h: longest gap in it that is interpolated, in hours.
        site: latitude, longitude, altitude_m, up and north where they are known (``heatsplat.datamodules.sun``).
        labels: classes of the points [P] as .npy, or None; labels.npy may be absent.
        features: features of the points [P, D] as .npy, or None; space_features.npy may be absent.
    """

    weather: str | None
    zone: str | None
    max_gap_h: float
    site: Mapping[str, Any]
    labels: str | None
    features: str | None

    def read(self, folder: Path, meta: Mapping[str, Any], frames: Sequence[RawFrame]) -> dict[str, Any]:
        """Fields of ``RawScene``: "weather", "labels" and "point_features", each None where there is none.

        Args:
            folder: of the scene.
            meta: where the scene itself says latitude, longitude, ...; options win.
            frames: on the clock of the record; their environments are the weather where there is no table.
        """
        labels = _array(folder, self.labels, LABELS_FILE, "labels", 1)
        if labels is not None and labels.dtype.kind not in "iu":
            if not np.array_equal(labels, np.rint(labels)):
                raise SceneError(f"data.labels: {folder / self.labels} holds {labels.dtype} values that are no classes")
            labels = labels.astype(np.int64)
        return {
            "weather": self._weather(folder, meta, frames),
            "labels": labels,
            "point_features": _array(folder, self.features, FEATURES_FILE, "features", 2),
        }

    def _weather(self, folder: Path, meta: Mapping[str, Any], frames: Sequence[RawFrame]) -> Weather | None:
        site = site_of({**meta, **{key: value for key, value in self.site.items() if value is not None}})
        path = _optional(folder, self.weather, WEATHER_FILE, "weather")
        if path is not None:
            return read_weather(path, zone=self.zone, site=site, max_gap_s=3600.0 * self.max_gap_h)
        known = [frame for frame in frames if frame.environment is not None and frame.time_s is not None]
        if len(known) < 2:
            return None
        columns = {}
        for name in WEATHER_COLUMNS:
            values = [getattr(frame.environment, name) for frame in known]
            if any(value is not None for value in values):
                columns[name] = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
        return make_weather(
            np.array([frame.time_s for frame in known]),
            columns,
            site=site,
            max_gap_s=3600.0 * self.max_gap_h,
            source="the weather of the single frames",
        )


class OutdoorDataModule(SceneDataModule):
    """A loader whose scenes may have weather, a place on earth, and classes and features of their points.

    Args:
        weather, weather_zone, weather_max_gap_h, labels, features: see ``Surroundings``; zone, gap and files.
        latitude, longitude, altitude_m, up, north: its site; None where it is not known, or where the scene says it.
        shared: options of every loader (``SceneDataModule``).
    """

    def __init__(
        self,
        *,
        weather: str | None = WEATHER_FILE,
        weather_zone: str | None = None,
        weather_max_gap_h: float = 3.0,
        latitude: float | None = None,
        longitude: float | None = None,
        altitude_m: float | None = None,
        up: Sequence[float] | None = None,
        north: Sequence[float] | None = None,
        labels: str | None = LABELS_FILE,
        features: str | None = FEATURES_FILE,
        **shared: Any,
    ) -> None:
        super().__init__(**shared)
        site = {"latitude": latitude, "longitude": longitude, "altitude_m": altitude_m, "up": up, "north": north}
        self.surroundings = Surroundings(weather, weather_zone, weather_max_gap_h, site, labels, features)


def environment_of(values: Mapping[str, Any] | None, where: str) -> Environment | None:
    """Weather values of one frame, or None without any. Raises SceneError naming ``where`` for a name it does not know."""
    values = mapping(values, f"{where}: env")
    if not values:
        return None
    if unknown := set(values) - set(WEATHER_COLUMNS):
        raise SceneError(
            f"{where}: env has {', '.join(sorted(unknown))}, which is none of {', '.join(WEATHER_COLUMNS)} (units are in "
            "the names)"
        )
    return Environment(
        **{name: None if value is None else finite(value, f"{where}: env {name}") for name, value in values.items()}
    )


def _optional(folder: Path, name: str | None, default: str, key: str) -> Path | None:
    """The file of an option; None where the option is, or where the default's file is absent."""
    if name is None:
        return None
    path = folder / Path(name).expanduser()
    if path.is_file():
        return path
    if name == default:
        return None
    raise SceneError(f"data.{key}={name}: there is no file {path}")


def _array(folder: Path, name: str | None, default: str, key: str, axes: int) -> np.ndarray | None:
    path = _optional(folder, name, default, key)
    if path is None:
        return None
    try:
        values = np.load(path, allow_pickle=False)
    except Exception as error:  # a damaged header ends in errors of numpy, of its parser and of its memory
        raise SceneError(f"data.{key}: {path} is no readable .npy file: {error}") from error
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "iuf":
        raise SceneError(f"data.{key}: {path} holds no table of numbers; save one array with numpy.save")
    if values.ndim != axes or not np.isfinite(values).all():
        shape = "[P]" if axes == 1 else "[P, D]"
        raise SceneError(
            f"data.{key}: {path} is {list(values.shape)} or not finite; {shape}, a row per point, is needed"
        )
    return values
