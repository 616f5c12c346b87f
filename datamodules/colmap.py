"""Any scene with images/ and a COLMAP sparse/0: the loader for one's own recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from heatsplat.contracts import SceneData, SceneError, ThermalRange, check_option, table_lines
from heatsplat.datamodules.base import CELSIUS, Counts, SceneDataModule
from heatsplat.datamodules.bounds import Spans, bounds_in, range_in
from heatsplat.datamodules.formats.colmap import find_model, nearly_model, read_model
from heatsplat.datamodules.formats.images import ImageIndex, read_image
from heatsplat.datamodules.formats.radiometric import has_temperatures, read_celsius, read_thermal
from heatsplat.datamodules.frame_times import FRAMES_FILE, FrameTimes
from heatsplat.datamodules.points import random_points, told_random
from heatsplat.datamodules.posed_frames import image_index, match_model, model_frames, named_as_files
from heatsplat.datamodules.side_files import finite, json_object, read_text

# Of a prepared folder: metres_per_unit of the sparse model, and its axes, where GPS has told them.
WORLD_FILE = "world.json"
META_FILE = "meta.csv"  # of a published flight: file, latitude and more of each frame


def _positions(folder: Path) -> Path | None:
    """The first table beside the scene that has a latitude."""
    for path in (folder / FRAMES_FILE, folder / META_FILE, folder.parent / META_FILE):
        if path.is_file():
            with suppress(SceneError):
                if "lat" in next((line for _, line in table_lines(read_text(path))), "").lower():
                    return path
    return None


def _uncertainty(image: Path) -> float | None:
    """Standard uncertainty in °C of the temperatures of a prepared image, at their median; None where that is not known."""
    path = image.with_suffix(".json")
    try:
        known = json_object(path).get("uncertainty_c") if path.is_file() else None
    except SceneError:  # notes of another program, which need not be readable
        return None
    value = known.get("combined") if isinstance(known, dict) else None
    return value if isinstance(value, float) else None


def _world(folder: Path) -> tuple[float | None, str | None]:
    """Metres of one unit of a prepared folder's world, and its axes in words; None where that is not known."""
    path = folder / WORLD_FILE
    world = json_object(path) if path.is_file() else {}
    scale, axes = world.get("metres_per_unit"), world.get("axes")
    return None if scale is None else finite(scale, f"{path}: 'metres_per_unit'"), axes and str(axes)


class Colmap(SceneDataModule):
    """Images, a sparse model, and as much about temperature and time as there is.

    Temperatures come from the first of: 16-bit counts in ``raw``; radiometric JPEGs (FLIR, DJI) among the images;
    bounds that say what black and white stand for; none. Times come from the first of: a table, a pattern, the frames.csv
    of a prepared folder, DJI file names; none.

    Args:
        images: folder of the thermal images; None for photos alone, those of ``rgb``.
        rgb: folder of visible images of the same cameras and names, or None.
        raw: folder of 16-bit counts with the same names, used in place of the images' greys, or None.
        raw_scale, raw_offset_c: °C = raw_scale * counts + raw_offset_c.
        radiometric: "auto" reads temperatures out of radiometric JPEGs, "never" takes their pictures as greys.
        bounds_c: [min, max] in °C that 0 and 1 stand for; None takes temperature_bounds.json, the span of each image in
            temperature_bounds.csv, or the data's own range.
        time_regex, time_format, time_csv, time_csv_name, time_csv_time: where times come from (``FrameTimes``).
        ambient_c: temperature of the surroundings in °C, or None.
        metres_per_unit: scale of the sparse model; None takes the world.json of a prepared folder, where there is one.
        random_points: number of points to make up where the sparse model has none.
        shared: options of every loader (``SceneDataModule``).
    """

    def __init__(
        self,
        *,
        images: str | None = "images",
        rgb: str | None = None,
        raw: str | None = None,
        raw_scale: float = 1.0 / 64.0,
        raw_offset_c: float = -273.15,
        radiometric: str = "auto",
        bounds_c: Sequence[float] | None = None,
        time_regex: str | None = None,
        time_format: str | None = None,
        time_csv: str | None = None,
        time_csv_name: str = "file",
        time_csv_time: str = "time_s",
        ambient_c: float | None = None,
        metres_per_unit: float | None = None,
        random_points: int = 20_000,
        **shared: Any,
    ) -> None:
        super().__init__(**shared)
        check_option("data.radiometric", radiometric, ("auto", "never"), SceneError)
        if images is None and (rgb is None or raw is not None):
            raise SceneError("data.images=null is for photos alone: give their folder as data.rgb, and no data.raw")
        if bounds_c is not None and len(bounds_c) != 2:
            raise SceneError(f"data.bounds_c needs two values [min, max] in °C, got {list(bounds_c)}")
        self.images = images
        self.rgb = rgb
        self.raw = raw
        self.counts = Counts(raw_scale, raw_offset_c)
        self.radiometric = radiometric
        self.bounds_c = bounds_c
        self.times = FrameTimes(time_regex, time_format, time_csv, time_csv_name, time_csv_time)
        self.ambient_c = ambient_c
        self.metres_per_unit = metres_per_unit
        self.random_points = random_points

    def load(self) -> SceneData:
        folder = self.scene_folder(lambda p: find_model(p) is not None, "a sparse model (sparse/0)", nearly_model)
        model = read_model(folder)
        raw = image_index(folder, self.raw, "data.raw") if self.raw else None
        rgb = image_index(folder, self.rgb, "data.rgb") if self.rgb else None
        index = raw or (image_index(folder, self.images, "data.images") if self.images else rgb)

        model = named_as_files(model, index)
        files = {name: index.find(name) for name in model.names}
        kept, notes = match_model(model, files, index, self.raw or self.images or self.rgb)
        read, counts, encoding = self._reader(raw, index, [files[i] for i in kept])
        notes["encoding"] = encoding
        times, notes["time_source"] = self.times.of(folder, kept)
        bounds, spans, bounds_notes = self._bounds(folder)
        metres_per_unit, axes = _world(folder)
        if axes:
            notes["axes"] = axes
        if (uncertainty := _uncertainty(index.folder / files[kept[0]])) is not None:
            notes["prepared_uncertainty_c"] = round(uncertainty, 2)
        notes |= bounds_notes

        def describe(name: str) -> dict[str, Any]:
            rgb_file = rgb.find(name) if rgb else None
            return {
                "time_s": times[name] if times else None,
                "read_rgb": partial(read_image, rgb.folder / rgb_file) if rgb_file else None,
            }

        frames = model_frames(self, folder, model, files, index.folder, read if self.images else None, describe)
        if masked := sum(f.read_mask is not None for f in frames):
            notes["masks"] = f"{masked} of {len(frames)} images have a mask in {self.masks}/ ({self.mask_keep} counts)"
        if rgb:
            if not any(f.read_rgb for f in frames):
                raise SceneError(
                    f"data.rgb={self.rgb}: no file in {rgb.folder} has the name of an image: there are names like "
                    f"{rgb.names[0]!r}, and images like {frames[0].name!r}"
                )
            notes["rgb"] = f"{sum(f.read_rgb is not None for f in frames)} of {len(frames)} images have a visible one"
        points, colors = model.points, model.colors
        if not len(points):
            points, colors = random_points([f.viewmat for f in frames], self.random_points, self.seed), None
            notes |= told_random(len(points), ": the sparse model has none")
        scene = self.finish(
            folder.name,
            frames,
            points,
            point_colors=colors,
            thermal_range=bounds,
            spans=spans,
            counts=counts,
            ambient_c=self.ambient_c,
            metres_per_unit=metres_per_unit if self.metres_per_unit is None else self.metres_per_unit,
            notes=notes,
        )
        return replace(scene, positions=_positions(folder))

    def _reader(
        self, raw: ImageIndex | None, index: ImageIndex, files: Sequence[str]
    ) -> tuple[Callable[[Path], np.ndarray], Counts | None, str]:
        """How an image file becomes stored numbers, what they mean, and a sentence about it."""
        if raw:
            c = self.counts
            return _read_counts, c, f"16-bit counts in {self.raw}/: °C = {c.scale:g} * counts {c.offset_c:+g}"
        if self.radiometric == "auto":
            having = [file for file in files if has_temperatures(index.folder / file)]
            if having and len(having) < len(files):
                lacking = next(file for file in files if file not in set(having))
                raise SceneError(
                    f"{len(having)} of {len(files)} images are radiometric JPEGs, {lacking} is not; "
                    "remove the others, or take all as greys with data.radiometric=never"
                )
            if having and self.palette is not None:
                raise SceneError(
                    f"data.palette={self.palette} changes nothing for radiometric JPEGs such as {having[0]}, whose temperatures "
                    "are read: leave it out (data.radiometric=never takes their pictures, and those have temperatures by "
                    "data.palette and bounds)"
                )
            if having:
                return read_celsius, CELSIUS, "temperatures of radiometric JPEGs (emissivity 1, no atmosphere)"
        return read_thermal, None, "greys, linear between the bounds where there are any"

    def _bounds(self, folder: Path) -> tuple[ThermalRange | None, Spans | None, dict[str, Any]]:
        if self.bounds_c is not None:
            return range_in("data.bounds_c", *self.bounds_c)[0], None, {"bounds_source": "data.bounds_c"}
        return bounds_in(folder)


def _read_counts(path: Path) -> np.ndarray:
    """Raw sensor counts [H, W] uint16. Raises SceneError for 8-bit or colour images, which hold no counts."""
    pixels = read_image(path)
    if pixels.dtype != np.uint16 or pixels.ndim != 2:
        channels = 1 if pixels.ndim == 2 else pixels.shape[2]
        raise SceneError(
            f"data.raw: {path} has {channels} channels of {pixels.dtype}, counts are one channel of uint16; "
            "leave data.raw out to use the images as greys"
        )
    return pixels
