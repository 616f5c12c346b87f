"""Scenes of the protocol as ``benchmark_folder`` writes them: a folder of what a method may know, and the truth elsewhere."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from heatsplat.contracts import SceneData, SceneError
from heatsplat.datamodules.base import RawFrame
from heatsplat.datamodules.benchmark_folder import META, SCENES, TRUTH
from heatsplat.datamodules.bounds import celsius_in, range_in
from heatsplat.datamodules.formats.images import read_image
from heatsplat.datamodules.formats.nerfstudio import Transforms, lens_in, read_transforms, viewmat_of
from heatsplat.datamodules.points import ply_points
from heatsplat.datamodules.posed_frames import FILES
from heatsplat.datamodules.side_files import finite, json_object
from heatsplat.datamodules.surroundings import OutdoorDataModule


class Benchmark(OutdoorDataModule):
    """root/scenes/scene with meta.json, transforms of both subsets, training images and points3D.ply; truth beside scenes/.

    Training images are what the camera recorded, test images the truth; both are float32 in °C.

    Args:
        truth: folder of the truth, with a folder for each scene; None for root/truth.
        rgb: True to load the visible images as well.
        shared: weather, site, classes and features (``OutdoorDataModule``), and options of every loader.
    """

    def __init__(self, *, truth: str | None = None, rgb: bool = True, split: str = "json", **shared: Any) -> None:
        super().__init__(split=split, **shared)
        self.truth, self.rgb = truth, rgb

    def load(self) -> SceneData:
        root = Path(self.root).expanduser().absolute() if self.root else None
        if root is not None and (root / SCENES).is_dir():
            self.root = str(root / SCENES)
        folder = self.scene_folder(lambda path: (path / META).is_file(), META)
        truth = Path(self.truth).expanduser() if self.truth else folder.parents[1] / TRUTH
        truth = truth / folder.name
        if not truth.is_dir():
            raise SceneError(
                f"there is no folder {truth}: a run measures its test views, whose images are kept apart; give the folder that "
                "holds them with data.truth=FOLDER"
            )
        meta = json_object(folder / META)
        frames: list[RawFrame] = []
        for subset, name in FILES.items():
            transforms = read_transforms(folder / name)
            frames += [self._frame(folder, truth, transforms, frame, subset, meta) for frame in transforms.frames]
        points, colors = ply_points(folder / "points3D.ply")
        low, high = (celsius_in(meta, key, folder / META) for key in ("min_value", "max_value"))
        return self.finish(
            folder.name,
            frames,
            points,
            point_colors=colors,
            thermal_range=range_in(folder / META, low, high)[0],
            ambient_c=meta.get("ambient_c"),
            metres_per_unit=meta.get("metres_per_unit"),
            notes={
                "source": f"protocol {meta.get('protocol')}, size {meta.get('size')}",
                "test_images": "exact",
                "cameras": f"{' and '.join(FILES.values())}, OpenGL axes",
            },
            **self.surroundings.read(folder, meta, frames),
        )

    def _frame(
        self,
        folder: Path,
        truth: Path,
        transforms: Transforms,
        frame: dict[str, Any],
        subset: str,
        meta: Mapping[str, Any],
    ) -> RawFrame:
        thermal = Path(frame["thermal_file_path"])
        image = folder / thermal if subset == "train" else truth / thermal.name
        visible = (folder if subset == "train" else truth) / frame["file_path"]
        seen = self.rgb and visible.suffix == ".png" and visible.is_file()
        time = frame.get("time_s")
        where = f"{transforms.path}: time_s of {thermal.name}"
        clock = meta.get("utc_at_zero_s") or 0.0
        return RawFrame(
            name=thermal.name,
            viewmat=viewmat_of(transforms, frame, opengl=True),
            lens=lens_in(transforms, frame, lambda: read_image(image).shape[1::-1]),
            read=partial(read_image, image),
            time_s=None if time is None else clock + finite(time, where, "a number of seconds"),
            read_rgb=partial(read_image, visible) if seen else None,
            subset=subset,
        )
