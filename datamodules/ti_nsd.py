"""TI-NSD, the data set of Thermal3D-GS: display intensities without temperatures, frame numbers for time."""

from __future__ import annotations

import re
from typing import Any

from heatsplat.contracts import SceneData, SceneError
from heatsplat.datamodules.base import SceneDataModule
from heatsplat.datamodules.file_names import stem_of
from heatsplat.datamodules.formats.colmap import find_model, read_model
from heatsplat.datamodules.posed_frames import image_index, match_model, model_frames

# Frames of the second part of a two-part scene (s2_<n>) are numbered on from here (Thermal3D-GS).
SECOND_PART = 486


class TINSD(SceneDataModule):
    """root/scene with images/<integer>.<ext> and sparse/0.

    Args:
        seconds_per_frame: interval between frame numbers in seconds. None follows the papers: time is
            number / (registered images - 1), about 0 .. 1, which is no second but what their models were made for.
        shared: options of every loader (``SceneDataModule``).
    """

    def __init__(self, *, split: str = "every_8th", seconds_per_frame: float | None = None, **shared: Any) -> None:
        super().__init__(split=split, **shared)
        if seconds_per_frame is not None and seconds_per_frame <= 0:
            raise SceneError(f"data.seconds_per_frame must be positive, got {seconds_per_frame}")
        self.seconds_per_frame = seconds_per_frame

    def load(self) -> SceneData:
        folder = self.scene_folder(lambda p: find_model(p) is not None, "a sparse model (sparse/0)")
        model = read_model(folder)
        index = image_index(folder, "images", "the folder of thermal images")
        files = {name: index.find(name) for name in model.names}
        kept, notes = match_model(model, files, index, "images")
        numbers = {name: frame_number(name) for name in kept}
        timed = all(number is not None for number in numbers.values())
        step = self.seconds_per_frame or 1.0 / max(1, len(model.names) - 1)
        if timed:
            notes["time_source"] = f"frame numbers times {step:g} " + (
                "s" if self.seconds_per_frame else "(number / (registered images - 1) as in the papers; not seconds)"
            )
        else:
            unnumbered = next(name for name, number in numbers.items() if number is None)
            notes["time_source"] = f"none: {unnumbered} is no frame number"

        def describe(name: str) -> dict[str, Any]:
            return {"time_s": numbers[name] * step if timed else None}

        frames = model_frames(self, folder, model, files, index.folder, describe=describe)
        return self.finish(folder.name, frames, model.points, point_colors=model.colors, notes=notes)


def frame_number(name: str) -> int | None:
    """The frame number in a name: <n>, s1_<n>, or s2_<n> with the second part's offset; None for any other name."""
    match = re.fullmatch(r"(?:s([12])_)?(\d+)", stem_of(name))
    if match is None:
        return None
    return int(match[2]) + (SECOND_PART if match[1] == "2" else 0)
