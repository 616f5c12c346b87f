"""ThermoScenes, the data set of ThermoNeRF: nerfstudio JSON, OpenGL poses, lens distortion, greys between bounds."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from heatsplat.datamodules.base import RawFrame, SceneDataModule
from heatsplat.datamodules.bounds import BOUNDS_FILE, read_bounds
from heatsplat.datamodules.formats.colmap import find_model, read_model
from heatsplat.datamodules.formats.images import ImageIndex, read_image
from heatsplat.datamodules.formats.nerfstudio import Transforms, lens_in, read_transforms, viewmat_of
from heatsplat.datamodules.points import ply_points, random_points
from heatsplat.datamodules.rgbt_scenes import is_paired, paired_frames
from heatsplat.datamodules.side_files import shortened
from heatsplat.datamodules.splits import SplitRule
from heatsplat.datamodules.timestamps import stem_of

from heatsplat.contracts import SceneData, SceneError, ThermalRange

VISIBLE_FOLDERS = ("images", "rgb", "msx")


class ThermoScenes(SceneDataModule):
    """root/scene with thermal/, images/, transforms_thermal.json (or transforms.json) and temperature_bounds.json.

    Scenes in the layout of RGBT-Scenes (sparse/0, thermal/{train,test}) are read as well. Points come from a COLMAP
    model in the scene, from the JSON's ply_file_path, or are random ones.

    Args:
        rgb: True to load the visible images as well.
        random_points: number of points to make up where the scene has none.
        shared: options of every loader (``SceneDataModule``).
    """

    def __init__(self, *, split: str = "names", rgb: bool = True, random_points: int = 20_000, **shared: Any) -> None:
        super().__init__(split=split, **shared)
        self.rgb = rgb
        self.random_points = random_points

    def load(self) -> SceneData:
        folder = self.scene_folder(lambda p: find_transforms(p) is not None or is_paired(p), "transforms_thermal.json")
        bounds, notes = _bounds(folder)
        path = find_transforms(folder)
        if path is None:
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
                notes=notes | found,
            )
        transforms = read_transforms(path)
        notes["cameras"] = f"{path.name}, OpenGL axes"
        frames, found = self._frames(folder, transforms)
        points, colors, source = self._points(folder, transforms, frames)
        notes |= found | {"points_source": source, "time_source": "none: the data set has no times"}
        split = self.split
        if split.rule == "names" and all(f.subset for f in frames):
            notes["split_source"] = f"train and test lists in {path.name}"
            split = SplitRule("json")
        return self.finish(
            folder.name,
            frames,
            points,
            split=split,
            point_colors=colors,
            thermal_range=bounds,
            notes=notes,
        )

    def _frames(self, folder: Path, transforms: Transforms) -> tuple[list[RawFrame], dict[str, Any]]:
        index, masks = ImageIndex(folder), ImageIndex(folder / self.masks)
        subset_of = _listed_subsets(transforms)
        frames, missing, visible = [], [], 0
        for frame in transforms.frames:
            file, rgb_file = _files_of(frame, index)
            if file is None:
                missing.append(str(frame["file_path"]))
                continue
            rgb_file = rgb_file if self.rgb else None
            visible += rgb_file is not None
            read = partial(read_image, folder / file)
            frames.append(
                RawFrame(
                    name=PurePosixPath(file).name,
                    viewmat=viewmat_of(transforms, frame, opengl=True),
                    lens=lens_in(transforms, frame, lambda read=read: read().shape[1::-1]),
                    read=read,
                    read_rgb=partial(read_image, folder / rgb_file) if rgb_file else None,
                    read_mask=self.mask_reader(masks, PurePosixPath(file).name),
                    subset=subset_of.get(stem_of(file)),
                )
            )
        if not frames:
            raise SceneError(
                f"none of the {len(transforms.frames)} frames of {transforms.path} has a thermal image in {folder}: "
                f"looked for {missing[0]} under thermal_file_path and in thermal/"
            )
        notes: dict[str, Any] = {"registered": len(transforms.frames)}
        if missing:
            notes["images_missing"] = f"{len(missing)} frames have no thermal image, dropped: {', '.join(missing[:5])}"
        if self.rgb:
            notes["rgb"] = f"{visible} of {len(frames)} images have a visible one"
        return frames, notes

    def _points(
        self, folder: Path, transforms: Transforms, frames: Sequence[RawFrame]
    ) -> tuple[np.ndarray, np.ndarray | None, str]:
        """Points in the world of the JSON, their colours, and where they come from."""
        rejected = ""
        if find_model(folder) is not None:
            model = read_model(folder)
            # The JSON's world is COLMAP's after applied_transform (nerfstudio turns the axes); its points go along.
            turn = transforms.applied_transform
            of_model = {stem_of(n): turn @ np.linalg.inv(v) for n, v in zip(model.names, model.viewmats, strict=True)}
            pairs = [
                (of_model[stem_of(f.name)], np.linalg.inv(f.viewmat)) for f in frames if stem_of(f.name) in of_model
            ]
            apart = max((float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in pairs), default=0.0)
            spread = np.ptp(np.stack([np.linalg.inv(f.viewmat)[:3, 3] for f in frames]), axis=0).max()
            if apart <= 0.05 * spread + 1e-6:
                place = model.folder.relative_to(folder)
                return model.points @ turn[:3, :3].T + turn[:3, 3], model.colors, f"{place} (COLMAP), applied_transform"
            rejected = f"; the model in {model.folder} is not used: its cameras lie up to {apart:.3g} units elsewhere"
        ply = transforms.values.get("ply_file_path")
        if ply and (folder / str(ply)).is_file():
            points, colors = ply_points(folder / str(ply))
            return points, colors, f"{ply}{rejected}"
        points = random_points([f.viewmat for f in frames], self.random_points, self.seed)
        return points, None, f"{len(points)} random points in the cube that the cameras look at{rejected}"


def find_transforms(folder: Path) -> Path | None:
    """The scene's JSON: transforms_thermal.json, transforms.json, or the only transforms*.json; else None."""
    for name in ("transforms_thermal.json", "transforms.json"):
        if (folder / name).is_file():
            return folder / name
    others = sorted(folder.glob("transforms*.json"))
    return others[0] if len(others) == 1 else None


def _bounds(folder: Path) -> tuple[ThermalRange | None, dict[str, Any]]:
    """Bounds, or None, and notes. The data set's own tools swap bounds in the wrong order, and so does this."""
    path = folder / BOUNDS_FILE
    if not path.is_file():
        return None, {"bounds_source": f"none: there is no {BOUNDS_FILE}"}
    bounds, swapped = read_bounds(path, swap=True)
    return bounds, {"bounds_source": path.name + (" (minimum and maximum were swapped)" if swapped else "")}


def _listed_subsets(transforms: Transforms) -> dict[str, str]:
    """Subset by file stem, from the lists that a transforms file may have (train_filenames, ...)."""
    subsets: dict[str, str] = {}
    for key, subset in (("train", "train"), ("val", "test"), ("eval", "test"), ("test", "test")):
        listed = transforms.values.get(f"{key}_filenames") or []
        if not isinstance(listed, list):
            raise SceneError(f"{transforms.path}: {key}_filenames is {shortened(listed)}, a list of names is needed")
        subsets |= {stem_of(str(name)): subset for name in listed}
    return subsets


def _files_of(frame: dict[str, Any], index: ImageIndex) -> tuple[str | None, str | None]:
    """Stored thermal and visible file of a frame, either may be None."""
    path = PurePosixPath(str(frame["file_path"]))
    candidates = [str(PurePosixPath(str(frame["thermal_file_path"])))] if "thermal_file_path" in frame else []
    candidates.append(f"thermal/{path.name}")
    if path.parent.name not in VISIBLE_FOLDERS:
        candidates.append(str(path))
    thermal = next((file for c in candidates if (file := index.find(c))), None)
    places = [str(path), f"images/{path.name}"]
    visible = next((file for c in places if (file := index.find(c)) and file != thermal), None)
    return thermal, visible
