"""Thermo, the data set of ThermoGS. It is not published, so this layout is our own: NTR's or COLMAP's, with weather."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from heatsplat.contracts import SceneData, SceneError
from heatsplat.datamodules.base import RawFrame
from heatsplat.datamodules.bounds import celsius_in, range_in
from heatsplat.datamodules.file_names import same_files
from heatsplat.datamodules.formats.colmap import find_model, read_model
from heatsplat.datamodules.posed_frames import FILES, image_index, listed_frames, match_model, mesh_points, model_frames
from heatsplat.datamodules.side_files import finite, json_object, mapping, shortened
from heatsplat.datamodules.surroundings import OutdoorDataModule, environment_of
from heatsplat.datamodules.weather_table import utc_seconds

META_FILE = "meta.json"


class Thermo(OutdoorDataModule):
    """root/scene with meta.json, poses (NTR's two JSON files, or images/ and sparse/0), and what else there is.

    meta.json holds min_value and max_value (°C of black and white) and may hold latitude, longitude, altitude_m, up,
    north, metres_per_unit, ambient_c, start_utc (of the frames' second 0) and frames: name -> {"utc", "env", "split"}.
    Frames of the JSON files may carry "utc" and "env" themselves, or "time" in seconds as in NTR. "env" holds any of
    the five weather values by the names of ``Environment``; weather.csv, where it is there, is used instead.

    Args:
        test_period: [from, to] in UTC or seconds; frames within are test, the others training, whatever the files say.
        min_c, max_c: temperatures of black and white; None takes meta.json's.
        ambient_c: temperature of the surroundings; None takes meta.json's, or the mean air temperature of the record.
        metres_per_unit: scale of the world; None takes meta.json's.
        random_points: number of points to make up where the scene has neither mesh nor sparse model.
        shared: weather, site, classes and features (``OutdoorDataModule``), and options of every loader. What meta.json
            says of the site is used where these give none.
    """

    def __init__(
        self,
        *,
        split: str = "json",
        alpha_mask: bool = True,
        test_period: Sequence[str | float] | None = None,
        min_c: float | None = None,
        max_c: float | None = None,
        ambient_c: float | None = None,
        metres_per_unit: float | None = None,
        random_points: int = 20_000,
        **shared: Any,
    ) -> None:
        super().__init__(split=split, alpha_mask=alpha_mask, **shared)
        if test_period is not None and (len(test_period) != 2 or split != "json"):
            raise SceneError(
                f"data.test_period={list(test_period)} with data.split={split}: two moments [from, to] and split=json"
            )
        self.test_period = test_period
        self.bounds_c = {"min_value": min_c, "max_value": max_c}
        self.ambient_c = ambient_c
        self.metres_per_unit = metres_per_unit
        self.random_points = random_points

    def load(self) -> SceneData:
        def is_scene(path: Path) -> bool:
            return (path / META_FILE).is_file() and (_has_transforms(path) or find_model(path) is not None)

        looked_for = f"{META_FILE} with {' and '.join(FILES.values())} or sparse/0"
        folder = self.scene_folder(is_scene, looked_for)
        path = folder / META_FILE
        meta = json_object(path)
        bounds = {k: celsius_in(meta, k, path) if own is None else own for k, own in self.bounds_c.items()}
        frames, scene, rows, notes = self._posed(folder, meta)
        if self.test_period is not None:
            frames = self._by_period(frames)
        surroundings = self.surroundings.read(folder, meta, frames)
        tables = {key: surroundings[key] for key in ("labels", "point_features") if surroundings[key] is not None}
        if tables and rows is not None:
            order = rows()
            surroundings |= {key: v[order] if len(v) == len(order) else v for key, v in tables.items()}
        if surroundings["weather"] is not None:  # one source for all frames
            frames = [replace(frame, environment=None) for frame in frames]
        ambient_c = meta.get("ambient_c") if self.ambient_c is None else self.ambient_c
        weather = surroundings["weather"]
        if ambient_c is None and weather is not None and weather.air_c is not None:
            ambient_c = round(float(weather.air_c.mean()), 2)
            notes["ambient_source"] = "mean air temperature of the record"
        metres = meta.get("metres_per_unit") if self.metres_per_unit is None else self.metres_per_unit
        if metres is None:
            notes["metres_per_unit"] = (
                "unknown: methods with areas refuse the scene until data.metres_per_unit is given"
            )
        return self.finish(
            folder.name,
            frames,
            thermal_range=range_in(path, bounds["min_value"], bounds["max_value"])[0],
            ambient_c=ambient_c,
            metres_per_unit=metres,
            notes={
                "layout": "our convention for Thermo, which is not published",
                "bounds_source": f"{META_FILE}, or data.min_c and data.max_c",
                **notes,
            },
            **scene,
            **surroundings,
        )

    def _posed(
        self, folder: Path, meta: Mapping[str, Any]
    ) -> tuple[list[RawFrame], dict[str, np.ndarray | None], Callable[[], np.ndarray] | None, dict[str, Any]]:
        """Frames, points with their colours, what tells their rows in a file of another order, and notes, from the JSON files or
        the sparse model."""
        if _has_transforms(folder):
            entries: list[Mapping[str, Any]] = []
            frames, notes = listed_frames(self, folder, lambda entry, _: entries.append(entry) or {})
            points, origin = mesh_points(folder, frames, self.random_points, self.seed)
            return self._described(meta, frames, entries), {"points": points}, None, notes | origin
        model = read_model(folder)
        index = image_index(folder, "images", "the folder of thermal images")
        files = {name: index.find(name) for name in model.names}
        _, notes = match_model(model, files, index, "images")
        frames = model_frames(self, folder, model, files, index.folder)
        scene = {"points": model.points, "point_colors": model.colors}
        notes = {"cameras": "sparse/0", **notes}
        return self._described(meta, frames, [{}] * len(frames)), scene, model.rows, notes

    def _described(
        self, meta: Mapping[str, Any], frames: Sequence[RawFrame], entries: Sequence[Mapping[str, Any]]
    ) -> list[RawFrame]:
        """The frames with their times, weather and subsets, from their own entries or from meta.json's.

        Raises:
            SceneError: meta.json names none of the frames, or says something of one that cannot be.
        """
        listed = mapping(meta.get("frames"), f"{META_FILE}: 'frames'")
        found = same_files([frame.name for frame in frames], listed)
        if listed and not any(found.values()):
            raise SceneError(
                f"{META_FILE}: 'frames' names none of the scene's frames: {next(iter(listed))} is not among "
                f"{frames[0].name}, ..."
            )

        def described(frame: RawFrame, entry: Mapping[str, Any]) -> RawFrame:
            key = frame.name if frame.name in listed else next(iter(found[frame.name]), None)
            where = f"{META_FILE}, frame {frame.name}"
            return replace(frame, **self._known({**mapping(listed.get(key), where), **entry}, meta, where))

        return [described(frame, entry) for frame, entry in zip(frames, entries, strict=True)]

    def _known(self, known: Mapping[str, Any], meta: Mapping[str, Any], where: str) -> dict[str, Any]:
        """Time, weather and, where it is said, subset of a frame, as fields of ``RawFrame``."""
        time = None
        if known.get("utc") is not None:
            time = utc_seconds(known["utc"], self.surroundings.zone, where)
        elif known.get("time") is not None:
            start = meta.get("start_utc")
            time = finite(known["time"], f"{where}: 'time'", "a number of seconds") + (
                0.0 if start is None else utc_seconds(start, self.surroundings.zone, f"{META_FILE}, start_utc")
            )
        result: dict[str, Any] = {"time_s": time, "environment": environment_of(known.get("env"), where)}
        if "split" not in known:
            return result
        if known["split"] not in ("train", "test", None):
            raise SceneError(f"{where}: split is {shortened(known['split'])}; train, test or null is needed")
        return {**result, "subset": known["split"]}

    def _by_period(self, frames: Sequence[RawFrame]) -> list[RawFrame]:
        """The frames, those within ``test_period`` as test and all others as training frames."""
        first, last = (utc_seconds(moment, self.surroundings.zone, "data.test_period") for moment in self.test_period)
        if any(frame.time_s is None for frame in frames):
            raise SceneError("data.test_period needs the time of every frame: utc in meta.json or in the JSON files")
        return [replace(f, subset="test" if first <= f.time_s <= last else "train") for f in frames]


def _has_transforms(folder: Path) -> bool:
    return all((folder / file).is_file() for file in FILES.values())
