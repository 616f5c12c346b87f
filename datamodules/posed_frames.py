"""Frames of the layouts that several data sets share: images that a COLMAP model has registered, and NTR's pair of JSON files."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np

from heatsplat.contracts import SceneError, counted
from heatsplat.datamodules.base import RawFrame, SceneDataModule
from heatsplat.datamodules.file_names import same_files
from heatsplat.datamodules.formats import temperature_table
from heatsplat.datamodules.formats.colmap import SparseModel
from heatsplat.datamodules.formats.colmap_records import announced_images
from heatsplat.datamodules.formats.images import ImageIndex, list_images
from heatsplat.datamodules.formats.nerfstudio import lens_in, read_transforms, viewmat_of
from heatsplat.datamodules.formats.radiometric import read_thermal
from heatsplat.datamodules.points import obj_vertices, random_points, told_random

log = logging.getLogger(__name__)

# Lists of frames by subset, in NTR's layout.
FILES = {"train": "transforms_train.json", "test": "transforms_test.json"}


def image_index(folder: Path, images: str, key: str) -> ImageIndex:
    """Files of an image folder of a scene. Raises SceneError naming the option ``key`` when the folder has none."""
    index = ImageIndex(folder / images)
    if not index.names:
        what = "holds no image" if index.folder.is_dir() else "does not exist"
        table = next(index.folder.rglob(f"*{temperature_table.SUFFIX}"), None)
        if table is not None:
            what += (
                f", but tables such as {table.name}: python src/prepare.py source={index.folder} target=NEW_FOLDER poses=given "
                f"poses.model={folder} makes a scene of tables of °C"
            )
        elif having := [
            f"{path.name}/" for path in sorted(folder.iterdir()) if path != index.folder and list_images(path)
        ]:
            what += f"; images lie in {', '.join(having)}"
        raise SceneError(f"{key}={images}: {index.folder} {what}")
    return index


def named_as_files(model: SparseModel, index: ImageIndex) -> SparseModel:
    """The model with the names of the files in a folder, where its own name other folders throughout, such as those of the
    computer that made it, and the names of files alone tell which is which; else as it is."""
    if any(index.find(name) for name in model.names):
        return model
    files = {name: found[0] for name, found in same_files(model.names, index.names).items() if len(found) == 1}
    if not files or len(set(files.values())) < len(files):  # of two cameras, say, in folders of their own
        return model
    log.info("images of %s are known by the names of their files, whatever folders it names", model.folder)
    names = [files.get(name, name) for name in model.names]
    order = sorted(range(len(names)), key=names.__getitem__)
    picked = {key: tuple(getattr(model, key)[i] for i in order) for key in ("viewmats", "lenses")}
    return replace(model, names=tuple(names[i] for i in order), **picked)


def match_model(
    model: SparseModel, files: dict[str, str | None], index: ImageIndex, folder: str
) -> tuple[list[str], dict[str, Any]]:
    """Names of the model that have a file, and notes about those that do not, about files that are not registered, and about a
    larger model beside it, of which the log warns.

    Raises:
        SceneError: no name of the model has a file.
    """
    kept = [name for name in model.names if files[name] is not None]
    if not kept:
        raise SceneError(
            f"none of the {len(model.names)} images of the sparse model {model.folder} is in {index.folder}: the model "
            f"has names like {model.names[0]!r}, the folder like {index.names[0]!r}"
        )
    notes: dict[str, Any] = {"registered": len(model.names), **_told_larger(model)}
    missing = [name for name in model.names if files[name] is None]
    notes |= told_missing(missing, len(model.names), f"a file in {folder}/", index.folder)
    used = [file for file in files.values() if file]
    taken = {_numbered(file) for file in used}
    unused = index.unused(used)
    if beside := [file for file in unused if _numbered(file) in taken]:
        notes["images_beside"] = (
            f"{counted(len(beside), 'file')} of another camera beside those of the model, unused: {_some(beside)}"
        )
    if unregistered := [file for file in unused if _numbered(file) not in taken]:
        notes["images_unregistered"] = (
            f"{counted(len(unregistered), 'file')} not in the model, unused: {_some(unregistered)}"
        )
    return kept, notes


def _numbered(file: str) -> str:
    """A file's name up to its last digit, which a drone's files of one moment share: DJI_20240806173449_0008 of ..._0008_T.JPG
    and ..._0008_V.JPG; as it is where it has no digits."""
    path = PurePosixPath(file)
    numbered = re.sub(r"\D+$", "", path.stem)
    return (path.parent / numbered).as_posix() if numbered else file


def _told_larger(model: SparseModel) -> dict[str, Any]:
    """A note on a model of more images beside one in sparse/0, sparse/1, ..., of which the log warns too; none without such.

    COLMAP numbers models that do not connect in the order in which it began them.
    """
    beside = [
        folder for folder in model.folder.parent.glob("[0-9]*") if folder.name.isdigit() and folder != model.folder
    ]
    largest = max(beside, key=announced_images, default=None)
    if not model.folder.name.isdigit() or largest is None or announced_images(largest) <= len(model.names):
        return {}
    note = f"{counted(len(model.names), 'image')}, and {largest.name} beside it has {announced_images(largest)}"
    log.warning("%s has %s: put that model in its place to train on those", model.folder, note)
    return {"larger_model": note}


def told_missing(missing: Sequence[str], count: int, lacking: str, folder: Path) -> dict[str, Any]:
    """A note on frames that are left out because their image is not there, of which the log warns too; none without such.

    Args:
        missing: their names.
        count: frames of the scene, those among them.
        lacking: what they have none of, for the note.
        folder: in which images were looked for.
    """
    if not missing:
        return {}
    note = f"{len(missing)} of {counted(count, 'frame')} without {lacking}, dropped: {_some(missing)}"
    log.warning("%s: %s; put these images there, or take the frames out of the list of cameras", folder, note)
    return {"images_missing": note}


def model_frames(
    module: SceneDataModule,
    scene: Path,
    model: SparseModel,
    files: Mapping[str, str | None],
    images: Path,
    read: Callable[[Path], np.ndarray] | None = read_thermal,
    describe: Callable[[str], dict[str, Any]] | None = None,
) -> list[RawFrame]:
    """The frames of a sparse model that have a file, in the order of the model, with their masks.

    Args:
        module: whose masks are looked up.
        scene: folder of the scene, which may hold masks.
        model: their poses and lenses.
        files: stored image of each name in the model, relative to ``images``, or None.
        images: folder of the images.
        read: function from a path to the stored thermal pixels; None for photos alone.
        describe: function from a name in the model to further fields of ``RawFrame``, such as time_s; a ``name`` among them
            replaces that of the model.
    """
    masks = module.mask_index(scene)
    frames = []
    for name, viewmat, lens in zip(model.names, model.viewmats, model.lenses, strict=True):
        file = files[name]
        if file is None:
            continue
        fields = {"name": name, **(describe(name) if describe else {})}
        frames.append(
            RawFrame(
                viewmat=viewmat,
                lens=lens,
                read=partial(read, images / file) if read else None,
                read_mask=module.mask_reader(masks, fields["name"]),
                **fields,
            )
        )
    module.warn_of_masks(masks, frames)
    return frames


def listed_frames(
    module: SceneDataModule, folder: Path, describe: Callable[[dict[str, Any], str], dict[str, Any]]
) -> tuple[list[RawFrame], dict[str, Any]]:
    """The frames of transforms_train.json and transforms_test.json that have an image, and notes on them and those without.

    Args:
        module: whose masks are looked up.
        folder: of the scene.
        describe: function from the entry of a frame and its file to further fields of ``RawFrame``, such as time_s.

    Raises:
        SceneError: no frame has an image.
    """
    index, masks = ImageIndex(folder), module.mask_index(folder)
    frames: list[RawFrame] = []
    missing: list[str] = []
    for subset, file_name in FILES.items():
        transforms = read_transforms(folder / file_name)
        for frame in transforms.frames:
            path = PurePosixPath(str(frame["file_path"]))
            file = index.find(str(path)) or index.find(f"{path}.png")
            if file is None:
                missing.append(str(path))
                continue
            read = partial(read_thermal, folder / file)
            # Some frames carry their own field of view; the file's holds for the others.
            fov = {"camera_angle_x": frame["FovX"]} if "FovX" in frame else {}
            frames.append(
                RawFrame(
                    name=file,
                    viewmat=viewmat_of(transforms, frame, opengl=False),
                    lens=lens_in(transforms, {**frame, **fov}, lambda read=read: read().shape[1::-1]),
                    read=read,
                    read_mask=module.mask_reader(masks, file),
                    **{"subset": subset, **describe(frame, file)},
                )
            )
    if not frames:
        raise SceneError(f"no frame of {folder / FILES['train']} has an image in {folder}: looked for {missing[0]}.png")
    module.warn_of_masks(masks, frames)
    count = len(frames) + len(missing)
    notes = {"registered": count, "cameras": f"{' and '.join(FILES.values())}, OpenCV axes"}
    return frames, notes | told_missing(missing, count, "an image", folder)


def mesh_points(folder: Path, frames: Sequence[RawFrame], count: int, seed: int) -> tuple[np.ndarray, dict[str, Any]]:
    """Points [P, 3] of a scene and notes on their origin: vertices of mesh.obj, or ``count`` random ones without it."""
    mesh = folder / "mesh.obj"
    if mesh.is_file():
        return obj_vertices(mesh), {"points_source": "vertices of mesh.obj"}
    points = random_points([f.viewmat for f in frames], count, seed)
    return points, told_random(len(points), ": no mesh.obj")


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:5]) + (" ..." if len(names) > 5 else "")
