"""ThermoScenes, the data set of ThermoNeRF: nerfstudio JSON, OpenGL poses, lens distortion, greys between bounds."""

from __future__ import annotations

from heatsplat.contracts import SceneData
from heatsplat.datamodules.formats.colmap import read_model
from heatsplat.datamodules.nerfstudio import Nerfstudio, bounds_of, find_transforms
from heatsplat.datamodules.rgbt_scenes import is_paired, paired_frames
from heatsplat.datamodules.splits import SplitRule


class ThermoScenes(Nerfstudio):
    """root/scene with thermal/, images/, transforms_thermal.json (or transforms.json) and temperature_bounds.json.

    Scenes in the layout of RGBT-Scenes (sparse/0, thermal/{train,test}) are read as well. Options are those of
    ``Nerfstudio``.
    """

    def load(self) -> SceneData:
        folder = self.scene_folder(lambda p: bool(find_transforms(p)) or is_paired(p), "transforms_thermal.json")
        if find_transforms(folder):
            return self.posed(folder)
        bounds, spans, notes = bounds_of(folder)
        model = read_model(folder)
        frames, found = paired_frames(self, folder, model, self.rgb)
        split = self.split
        if split.rule == "names" and all(f.subset for f in frames):
            split = SplitRule("folders")  # this layout says in its folders what the other says in its names
        return self.finish(
            folder.name,
            frames,
            model.points,
            split=split,
            point_colors=model.colors,
            thermal_range=bounds,
            spans=spans,
            notes=notes | found,
        )
