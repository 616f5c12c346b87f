"""Scenes as nerfstudio, instant-ngp and their relatives write them: transforms*.json beside images."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from heatsplat.contracts import SceneData, SceneError, ThermalRange, counted
from heatsplat.datamodules.base import RawFrame, SceneDataModule
from heatsplat.datamodules.bounds import BOUNDS_FILE, Spans, bounds_in
from heatsplat.datamodules.file_names import same_files
from heatsplat.datamodules.formats.colmap import find_model, read_model
from heatsplat.datamodules.formats.images import (
    PSEUDO_COLOUR_LEVELS,
    ImageIndex,
    colour_levels,
    read_image,
    split_alpha,
)
from heatsplat.datamodules.formats.nerfstudio import (
    TIME_KEYS,
    Transforms,
    lens_in,
    read_transforms,
    time_in,
    viewmat_of,
)
from heatsplat.datamodules.formats.radiometric import read_thermal
from heatsplat.datamodules.frame_times import FrameTimes
from heatsplat.datamodules.points import ply_points, random_points, told_random
from heatsplat.datamodules.posed_frames import told_missing
from heatsplat.datamodules.side_files import shortened
from heatsplat.datamodules.splits import TEST_WORDS, TRAIN_WORDS, SplitRule

log = logging.getLogger(__name__)

THERMAL_FOLDERS = ("thermal", "ir", "infrared")


@dataclass(frozen=True)
class Entry:
    """A frame as a transforms file lists it, and its stored files.

    Args:
        transforms: file that lists it.
        subset: that the whole file is of, or None.
        frame: its keys.
        thermal, visible: stored images relative to the scene, or None; one that nothing calls thermal is visible.
    """

    transforms: Transforms
    subset: str | None
    frame: Mapping[str, Any]
    thermal: str | None
    visible: str | None


class Nerfstudio(SceneDataModule):
    """root/scene with transforms.json (or transforms_thermal.json, or transforms_train.json and transforms_test.json).

    Poses are camera-to-world in OpenGL axes. A frame names its thermal image (thermal_file_path, thermal, ir) and its
    visible one (file_path, rgb, image), or one image of file_path. That is thermal where it lies in thermal/, or is grey,
    or the scene has temperature bounds; coloured ones are photos, and the scene an RGB scene. Points come from a COLMAP
    model in the scene, from the JSON's ply_file_path, or are random ones. Times are those of the frames (time_s, or time, in
    seconds), unless a table or a pattern is given. What was assumed stands in the notes.

    Args:
        rgb: True to load the visible images as well.
        time_regex, time_format, time_csv, time_csv_name, time_csv_time: where times come from (``FrameTimes``).
        random_points: number of points to make up where the scene has none.
        shared: options of every loader (``SceneDataModule``). The split "names" takes what the JSON lists, without
            frames in none of its lists, and every 8th frame where neither it nor any name speaks of train or test.
    """

    def __init__(
        self,
        *,
        split: str = "names",
        rgb: bool = True,
        time_regex: str | None = None,
        time_format: str | None = None,
        time_csv: str | None = None,
        time_csv_name: str = "file",
        time_csv_time: str = "time_s",
        random_points: int = 20_000,
        **shared: Any,
    ) -> None:
        super().__init__(split=split, **shared)
        self.rgb = rgb
        self.times = FrameTimes(time_regex, time_format, time_csv, time_csv_name, time_csv_time)
        self.random_points = random_points

    def load(self) -> SceneData:
        return self.posed(self.scene_folder(lambda p: bool(find_transforms(p)), "transforms.json"))

    def posed(self, folder: Path) -> SceneData:
        """The scene of the transforms files in a folder."""
        bounds, spans, notes = bounds_of(folder)
        listed = {read_transforms(path): subset for path, subset in find_transforms(folder).items()}
        first = next(iter(listed))
        notes["cameras"] = f"{' and '.join(t.path.name for t in listed)}, OpenGL axes"
        if first.assumed:
            notes["keys_assumed"] = f"image paths stand under {first.assumed}"
        frames, found = self._frames(folder, listed, bounds)
        if self.split.rule in ("names", "json") and any(f.subset for f in frames):
            if unlisted := [f.name for f in frames if not f.subset]:
                found["images_unlisted"] = (
                    f"{counted(len(unlisted), 'frame')} in no list, dropped: {', '.join(unlisted[:5])}"
                )
                log.warning("scene %s: %s of %s", folder.name, found["images_unlisted"], first.path.name)
            frames = [f for f in frames if f.subset]
        points, colors, origin = self._points(folder, first, frames)
        notes |= found | origin
        split, says = self._split(frames, first)
        notes |= says
        if assumed := [notes[key] for key in ("keys_assumed", "images_assumed", "split_assumed") if key in notes]:
            log.info("scene %s: %s", folder.name, "; ".join(assumed))
        return self.finish(
            folder.name,
            frames,
            points,
            split=split,
            point_colors=colors,
            thermal_range=None if frames[0].read is None else bounds,
            spans=spans,
            notes=notes,
        )

    def _split(self, frames: Sequence[RawFrame], transforms: Transforms) -> tuple[SplitRule, dict[str, str]]:
        """The rule, and a note where it is not the one that was asked for."""
        if self.split.rule != "names":
            return self.split, {}
        if frames[0].subset:
            return SplitRule("json"), {"split_source": f"train and test lists in {transforms.path.name}"}
        stems = [PurePosixPath(f.name).stem.lower() for f in frames]
        said = {tuple(any(word in stem for word in words) for words in (TRAIN_WORDS, TEST_WORDS)) for stem in stems}
        if len(said) > 1:  # what all names say, as valley_001 and terrain_001 do, tells none apart
            return self.split, {}
        says = f"every 8th frame is test: neither names nor {transforms.path.name} tell train and test apart"
        return SplitRule("every_8th"), {"split_assumed": says}

    def _frames(
        self, folder: Path, listed: Mapping[Transforms, str | None], bounds: ThermalRange | None
    ) -> tuple[list[RawFrame], dict[str, Any]]:
        index, masks = ImageIndex(folder), self.mask_index(folder)
        entries, photos, assumed = self._told_apart(folder, _entries(folder, listed, index), bounds)
        notes: dict[str, Any] = {"registered": len(entries), **assumed}
        _check_thermal(entries)
        subsets = _listed_subsets([*listed], entries)
        mains = [entry.visible if photos else entry.thermal for entry in entries]
        names = _names(mains, several=len(listed) > 1)
        frames, missing, written = [], [], {}
        for entry, main, name, in_list in zip(entries, mains, names, subsets, strict=True):
            if main is None:
                missing.append(str(entry.frame["file_path"]))
                continue
            rgb_file = entry.visible if self.rgb or photos else None
            read = partial(read_thermal, folder / main)
            frames.append(
                RawFrame(
                    name=name,
                    viewmat=viewmat_of(entry.transforms, entry.frame, opengl=True),
                    lens=lens_in(entry.transforms, entry.frame, lambda read=read: read().shape[1::-1]),
                    read=None if photos else read,
                    read_rgb=partial(read_image, folder / rgb_file) if rgb_file else None,
                    read_mask=self._named_mask(folder, index, entry) or self.mask_reader(masks, name),
                    subset=entry.subset or in_list,
                )
            )
            written[name] = time_in(entry.transforms, entry.frame)
        if not frames:
            raise SceneError(
                f"none of the {len(entries)} frames of {next(iter(listed)).path} has a thermal image in {folder}: "
                f"looked for {missing[0]} under thermal_file_path and in thermal/"
            )
        self.warn_of_masks(masks, frames)
        notes |= told_missing(missing, len(entries), "a thermal image", folder)
        if self.rgb:
            notes["rgb"] = f"{sum(f.read_rgb is not None for f in frames)} of {len(frames)} images have a visible one"
        times, notes["time_source"] = self._times(folder, written, [*listed][0])
        return [replace(f, time_s=times[f.name]) for f in frames] if times else frames, notes

    def _told_apart(
        self, folder: Path, entries: list[Entry], bounds: ThermalRange | None
    ) -> tuple[list[Entry], bool, dict[str, str]]:
        """The entries, whether they are of an RGB scene, and a note of what was assumed where nothing says which images are
        thermal: grey ones are, and all where the scene has temperature bounds."""
        unnamed = [entry.visible for entry in entries if entry.visible]
        if not unnamed or any(entry.thermal or "thermal_file_path" in entry.frame for entry in entries):
            return entries, False, {}
        pixels, _ = split_alpha(read_image(folder / unnamed[0]))
        pseudo_colour = self.thermal_channels == 3 or self.palette is not None
        photos = colour_levels(pixels) > PSEUDO_COLOUR_LEVELS and bounds is None and not pseudo_colour
        what = "photos (they are in colour)" if photos else "thermal images"
        said = (
            f"images such as {unnamed[0]} are taken as {what}: no key, folder or bounds file says what they are. Name "
            "thermal ones thermal_file_path, or set data.palette (or data.thermal_channels=3) for pseudo-colour"
        )
        if not photos:
            entries = [replace(entry, thermal=entry.visible, visible=None) for entry in entries]
        return entries, photos, {"images_assumed": said}

    def _named_mask(self, folder: Path, index: ImageIndex, entry: Entry) -> Callable[[], np.ndarray] | None:
        """Reads the mask that a frame names under mask_path. Raises SceneError where there is none of that name."""
        named = str(entry.frame.get("mask_path") or "").replace("\\", "/")
        if not named:
            return None
        place = PurePosixPath(entry.transforms.path.parent.relative_to(folder).as_posix())
        found = self.mask_reader(index, str(place / named))
        if found is None:
            raise SceneError(
                f"{entry.transforms.path}: mask_path of {entry.frame['file_path']} is {named}, which is not there; put the mask "
                "there, or take mask_path out"
            )
        return found

    def _times(
        self, folder: Path, written: Mapping[str, float | None], transforms: Transforms
    ) -> tuple[Mapping[str, float] | None, str]:
        """Seconds by name, or None, and a note. Raises SceneError where some frames have a time and others have not."""
        known = {name: time for name, time in written.items() if time is not None}
        if known and len(known) < len(written) and not self.times.are_told:
            lacking = next(name for name in written if name not in known)
            raise SceneError(
                f"{transforms.path}: {lacking} has no {' or '.join(TIME_KEYS)}, which {len(known)} of {len(written)} frames "
                "have: give all frames one, or none, or data.time_csv"
            )
        where = f"{transforms.path.name}, in seconds"
        if known and min(known.values()) >= 0.0 and max(known.values()) == 1.0:
            where += (
                " (all lie from 0 to 1: if they are shares of the recording, rates and time constants are in those)"
            )
        return self.times.of(folder, list(written), known or None, where)

    def _points(
        self, folder: Path, transforms: Transforms, frames: Sequence[RawFrame]
    ) -> tuple[np.ndarray, np.ndarray | None, dict[str, Any]]:
        """Points in the world of the JSON, their colours, and notes about where they come from."""
        rejected = ""
        if find_model(folder) is not None:
            model = read_model(folder)
            # The JSON's world is COLMAP's after applied_transform (nerfstudio turns the axes); its points go along.
            turn = transforms.applied_transform
            of_model = {n: turn @ np.linalg.inv(v) for n, v in zip(model.names, model.viewmats, strict=True)}
            named = same_files([f.name for f in frames], of_model)
            centers = np.stack([np.linalg.inv(f.viewmat)[:3, 3] for f in frames])
            pairs = [(of_model[n], center) for f, center in zip(frames, centers, strict=True) for n in named[f.name]]
            apart = max((float(np.linalg.norm(pose[:3, 3] - center)) for pose, center in pairs), default=0.0)
            if not pairs:  # the model may be of photos that are called otherwise: their places tell
                apart = float(cKDTree([pose[:3, 3] for pose in of_model.values()]).query(centers)[0].max())
            spread = np.ptp(centers, axis=0).max()
            if apart <= 0.05 * spread + 1e-6:
                place = model.folder.relative_to(folder)
                points = model.points @ turn[:3, :3].T + turn[:3, 3]
                return points, model.colors, {"points_source": f"{place} (COLMAP), applied_transform"}
            rejected = f"; the model in {model.folder} is not used: its cameras lie up to {apart:.3g} units elsewhere"
        if ply := str(transforms.values.get("ply_file_path") or "").replace("\\", "/"):
            path = transforms.path.parent / ply
            if path.is_file():
                points, colors = ply_points(path)
                return points, colors, {"points_source": f"{ply}{rejected}"}
            rejected += f"; ply_file_path of {transforms.path.name} is {ply}, which is not there"
            log.warning("scene %s begins with random points%s", folder.name, rejected)
        points = random_points([f.viewmat for f in frames], self.random_points, self.seed)
        return points, None, told_random(len(points), rejected)


def find_transforms(folder: Path) -> dict[Path, str | None]:
    """The scene's JSON files with the subset that each holds (None: all frames), of the first of these, or none.

    In the folder, or else in its folder thermal/: transforms_thermal.json; transforms.json; transforms_train.json with
    transforms_test.json (or transforms_val.json); the only transforms*.json.
    """
    for place in (folder, folder / "thermal"):
        for name in ("transforms_thermal.json", "transforms.json"):
            if (place / name).is_file():
                return {place / name: None}
        train = place / "transforms_train.json"
        tests = [path for word in ("test", "val") if (path := place / f"transforms_{word}.json").is_file()]
        if train.is_file() and tests:
            return {train: "train", tests[0]: "test"}
        others = sorted(place.glob("transforms*.json"))
        if len(others) == 1:
            return {others[0]: None}
    return {}


def bounds_of(folder: Path) -> tuple[ThermalRange | None, Spans | None, dict[str, Any]]:
    """Bounds, or None, those of each image, or None, and notes. ThermoScenes' own tools swap bounds in the wrong order, and so
    does this."""
    bounds, spans, notes = bounds_in(folder, swap=True)
    return bounds, spans, notes or {"bounds_source": f"none: there is no {BOUNDS_FILE}"}


def _entries(folder: Path, listed: Mapping[Transforms, str | None], index: ImageIndex) -> list[Entry]:
    """The frames of the transforms files, each with its stored images."""
    apart = any((folder / "thermal").glob("transforms*.json"))  # thermal images have cameras of their own
    if apart and (first := next(iter(listed))).path.parent == folder:
        log.warning(
            "scene %s: the cameras are those of %s; for those in thermal/ give data.root=%s data.scene=null",
            *(folder.name, first.path.name, folder / "thermal"),
        )
    entries = []
    for transforms, subset in listed.items():
        place = transforms.path.parent.relative_to(folder)
        entries += [
            Entry(transforms, subset, frame, *_files_of(frame, place, index, apart)) for frame in transforms.frames
        ]
    return entries


def _names(mains: Sequence[str | None], several: bool) -> list[str | None]:
    """Names of frames by their images' files, with folders where two have one name, or there are ``several`` transforms files."""
    plain_names = [None if main is None else PurePosixPath(main).name for main in mains]
    known = [name for name in plain_names if name is not None]
    return list(mains) if several or len(set(known)) < len(known) else plain_names


def _check_thermal(entries: Sequence[Entry]) -> None:
    """Raises SceneError where frames of different images have one thermal image: only one of the poses can be its own."""
    named: dict[str, str] = {}
    for entry in entries:
        path = str(entry.frame["file_path"])
        if entry.thermal and (other := named.setdefault(entry.thermal, path)) != path:
            raise SceneError(
                f"{entry.transforms.path}: the thermal image of both {other} and {path} would be {entry.thermal}; name that of "
                "each thermal_file_path, or put them into folders of the same names in thermal/"
            )


def _listed_subsets(files: Sequence[Transforms], entries: Sequence[Entry]) -> list[str | None]:
    """Subset of each frame, from the lists that a transforms file may have (train_filenames, ...).

    They name what stands under file_path, or the stored image.

    Raises:
        SceneError: a list is none, or names no frame, or two subsets name the same.
    """
    subset_of: dict[str, str] = {}
    for transforms in files:
        for key, subset in (("train", "train"), ("val", "test"), ("eval", "test"), ("test", "test")):
            listed = transforms.values.get(f"{key}_filenames") or []
            if not isinstance(listed, list):
                raise SceneError(
                    f"{transforms.path}: {key}_filenames is {shortened(listed)}, a list of names is needed"
                )
            subset_of |= {str(name): subset for name in listed}
    paths = [str(entry.frame["file_path"]) for entry in entries]
    stored = [entry.thermal or entry.visible or path for entry, path in zip(entries, paths, strict=True)]
    found = [same_files(names, subset_of) for names in (paths, stored)]
    subsets = []
    for path, file in zip(paths, stored, strict=True):
        named = {subset_of[name] for name in found[0][path] or found[1][file]}
        if len(named) > 1:
            raise SceneError(
                f"{files[0].path}: the lists name {path} both for training and for testing; keep one of them"
            )
        subsets.append(next(iter(named), None))
    if subset_of and not any(subsets):
        raise SceneError(
            f"{files[0].path}: its lists name none of its frames: {next(iter(subset_of))} is not among {paths[0]}, ..."
        )
    return subsets


def _files_of(frame: Mapping[str, Any], place: Path, index: ImageIndex, apart: bool) -> tuple[str | None, str | None]:
    """Stored thermal and visible file of a frame of a JSON in ``place``, either may be None.

    A file of which nothing says that it is thermal is a visible one here. Folders below thermal/ are those of photos, unless it
    has cameras of its own (``apart``).
    """
    path = PurePosixPath(place.as_posix()) / frame["file_path"]
    candidates = [PurePosixPath(place.as_posix()) / frame["thermal_file_path"]] if "thermal_file_path" in frame else []
    # Folders of cameras or subsets may go on below: thermal/left/0001.png beside images/left/0001.png.
    tails = [PurePosixPath(*path.parts[first:]) for first in range(len(path.parts))][-1 if apart else 0 :]
    candidates += ["thermal" / tail for tail in tails]
    if set(path.parts[:-1]) & set(THERMAL_FOLDERS):
        candidates.append(path)
    thermal = next((file for c in candidates if (file := index.find(str(c)))), None)
    if place.parts and thermal:  # thermal/ has cameras of its own, which no visible image shares
        return thermal, None
    places = (path, *(folder / tail for folder in ("images", "rgb") for tail in tails))
    return thermal, next((file for c in places if (file := index.find(str(c))) and file != thermal), None)
