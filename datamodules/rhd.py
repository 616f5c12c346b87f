"""RHD, the data set of ETGS: radiometric frames with the time of day in their names, one scene cooling or heating."""

from __future__ import annotations

import logging
import re
from pathlib import Path, PurePosixPath
from typing import Any

from heatsplat.contracts import SceneData, ThermalRange
from heatsplat.datamodules.base import SceneDataModule
from heatsplat.datamodules.bounds import celsius_in, range_in
from heatsplat.datamodules.formats.colmap import find_model, read_model
from heatsplat.datamodules.formats.images import ImageIndex
from heatsplat.datamodules.posed_frames import image_index, match_model, model_frames
from heatsplat.datamodules.side_files import json_object
from heatsplat.datamodules.timestamps import seconds_of_day, unrolled_midnight

log = logging.getLogger(__name__)

# What ETGS's code assumes where info.json does not say.
DEFAULT_AMBIENT_C = 26.0
DEFAULT_MARGIN_K = 5.0


class RHD(SceneDataModule):
    """root/scene/thermal with images/HHMMSSmmm.png, sparse/0 and info.json; root/scene may be that folder itself.

    Greys are temperatures, linear between min_value and max_value of info.json; T_env there is the ambient temperature.
    Times come from the file names. (ETGS's own code takes the rank among registered cameras, which shifts all later
    times when an image is not registered.)

    Args:
        shared: options of every loader (``SceneDataModule``).
    """

    def __init__(self, *, split: str = "quarter_centre", **shared: Any) -> None:
        super().__init__(split=split, **shared)

    def load(self) -> SceneData:
        def has_model(path: Path) -> bool:
            return find_model(path / "thermal") is not None or find_model(path) is not None

        scene = self.scene_folder(has_model, "a sparse model (thermal/sparse/0)")
        folder = scene / "thermal" if find_model(scene / "thermal") else scene
        name = scene.parent.name if scene.name == "thermal" else scene.name
        model = read_model(folder)
        index = image_index(folder, "images", "the folder of thermal images")
        files = _files_of(model.names, index)
        kept, notes = match_model(model, files, index, "images")
        times, time_notes = _times([files[name] for name in kept])
        bounds, ambient_c, info_notes = _info(folder)
        notes |= time_notes | info_notes
        if (scene / "rgb").is_dir():
            notes["rgb"] = "visible images have cameras of their own and are not used"

        def describe(name_in_model: str) -> dict[str, Any]:
            file = files[name_in_model]
            return {"name": file, "time_s": times[file] if times else None}

        frames = model_frames(self, folder, model, files, index.folder, describe=describe)
        return self.finish(
            name,
            frames,
            model.points,
            point_colors=model.colors,
            thermal_range=bounds,
            ambient_c=ambient_c,
            notes=notes,
        )


def _digits(name: str) -> str | None:
    """The nine digits of a file name, whatever stands before or after them; of more in a row none says which are the time."""
    match = re.search(r"(?<!\d)\d{9}(?!\d)", PurePosixPath(name).stem)
    return match[0] if match else None


def _files_of(names: tuple[str, ...], index: ImageIndex) -> dict[str, str | None]:
    """Stored file of each name in the sparse model.

    Models of older copies were solved on visible images: their names say "color" for "red", or carry a prefix.
    """
    by_digits = {digits: file for file in index.names if (digits := _digits(file))}

    def file_of(name: str) -> str | None:
        candidates = (name, name.replace("color", "red"), name.partition("_")[2])
        found = next((file for c in candidates if c and (file := index.find(c))), None)
        return found or by_digits.get(_digits(name) or "")

    return {name: file_of(name) for name in names}


def _times(files: list[str]) -> tuple[dict[str, float] | None, dict[str, Any]]:
    """Seconds by file, or None, and notes."""
    try:
        of_day = [seconds_of_day(_digits(file) or PurePosixPath(file).stem) for file in files]
    except ValueError as error:
        source = f"none: file names are not HHMMSSmmm ({error})"
        log.warning("times: %s", source)
        return None, {"time_source": source}
    times, passed = unrolled_midnight(of_day)
    notes: dict[str, Any] = {"time_source": "file names, HHMMSSmmm"}
    if passed:
        notes["midnight"] = "the recording passes midnight: 24 h were added to the times after it"
    return dict(zip(files, times, strict=True)), notes


def _info(folder: Path) -> tuple[ThermalRange, float, dict[str, Any]]:
    """Bounds, ambient temperature in °C, and notes on what had to be assumed."""
    path = next((p for p in (folder / "info.json", folder.parent / "info.json") if p.is_file()), folder / "info.json")
    info = json_object(path) if path.is_file() else {}
    ambient_c = celsius_in(info, "T_env", path) if "T_env" in info else DEFAULT_AMBIENT_C
    low = celsius_in(info, "min_value", path) if "min_value" in info else ambient_c - DEFAULT_MARGIN_K
    high = celsius_in(info, "max_value", path) if "max_value" in info else ambient_c + DEFAULT_MARGIN_K
    bounds, _ = range_in(path, low, high)
    notes: dict[str, Any] = {"bounds_source": path.name, "ambient_source": path.name}
    if missing := [key for key in ("T_env", "min_value", "max_value") if key not in info]:
        text = (
            f"{path} does not give {', '.join(missing)}; ETGS's defaults are assumed (T_env {ambient_c:g} °C, bounds "
            f"{low:g} .. {high:g} °C), so errors in °C are only as good as these. Write the file to say better."
        )
        log.warning(text)
        notes["bounds_assumed"] = text
    return bounds, ambient_c, notes
