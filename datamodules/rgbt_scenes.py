"""RGBT-Scenes, the data set of ThermalGaussian: paired visible and pseudo-colour thermal images.

The data set has no temperatures; where its palette is named and someone has written down bounds, there are.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneData
from heatsplat.datamodules.base import RawFrame, SceneDataModule
from heatsplat.datamodules.formats.colmap import SparseModel, find_model, read_model
from heatsplat.datamodules.formats.images import ImageIndex, read_image
from heatsplat.datamodules.nerfstudio import bounds_of
from heatsplat.datamodules.posed_frames import image_index, match_model, model_frames

SUBSETS = {"train": "train", "test": "test", "eval": "test", "val": "test"}


class RGBTScenes(SceneDataModule):
    """root/scene with rgb/{train,test}, thermal/{train,test} and one sparse/0 for both.

    Args:
        rgb: True to load the visible images as well.
        thermal_channels: 3 for the colours, 1 for their luma; None for 3, or for levels where ``palette`` is given.
        shared: options of every loader (``SceneDataModule``).
    """

    def __init__(
        self, *, split: str = "folders", thermal_channels: int | None = None, rgb: bool = True, **shared: Any
    ) -> None:
        if thermal_channels is None:
            thermal_channels = 3 if shared.get("palette") is None else 1
        super().__init__(split=split, thermal_channels=thermal_channels, **shared)
        self.rgb = rgb

    def load(self) -> SceneData:
        folder = self.scene_folder(is_paired, "thermal/ or a sparse model (sparse/0)")
        model = read_model(folder)
        frames, notes = paired_frames(self, folder, model, self.rgb)
        bounds, spans, bounds_notes = bounds_of(folder)
        return self.finish(
            folder.name,
            frames,
            model.points,
            point_colors=model.colors,
            thermal_range=bounds,
            spans=spans,
            notes=notes | (bounds_notes if bounds else {}),
        )


def is_paired(folder: Path) -> bool:
    """True for a folder in this layout."""
    return (folder / "thermal").is_dir() and find_model(folder) is not None


def paired_frames(
    module: SceneDataModule, folder: Path, model: SparseModel, with_rgb: bool
) -> tuple[list[RawFrame], dict[str, Any]]:
    """Frames of a scene in this layout with the subset that their folder says, and notes.

    Raises:
        SceneError: no image of the model is in thermal/.
    """
    thermal = image_index(folder, "thermal", "the folder of thermal images")
    rgb = ImageIndex(folder / "rgb")
    files: dict[str, str | None] = {}
    subsets: dict[str, str | None] = {}
    for name in model.names:
        places = [(thermal.find(f"{place}/{name}"), subset) for place, subset in SUBSETS.items()]
        places.append((thermal.find(name), None))
        files[name], subsets[name] = next((p for p in places if p[0]), (None, None))
    _, notes = match_model(model, files, thermal, "thermal")

    def describe(name: str) -> dict[str, Any]:
        rgb_file = rgb.find(files[name]) if with_rgb else None
        return {
            "read_rgb": partial(read_image, rgb.folder / rgb_file) if rgb_file else None,
            "subset": subsets[name],
        }

    frames = model_frames(module, folder, model, files, thermal.folder, describe=describe)
    if with_rgb:
        notes["rgb"] = f"{sum(f.read_rgb is not None for f in frames)} of {len(frames)} images have a visible one"
    notes["time_source"] = "none: the data set has no times"
    return frames, notes
