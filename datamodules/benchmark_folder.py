"""Scenes of a protocol as plain folders: what a method may know, and apart from it the truth that it is scored by."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from plyfile import PlyData, PlyElement

from heatsplat.contracts import SceneData, SceneError, View, ViewSet
from heatsplat.datamodules.base import SceneDataModule
from heatsplat.datamodules.formats.colmap import pinholes, write_model
from heatsplat.datamodules.posed_frames import FILES
from heatsplat.datamodules.surroundings import FEATURES_FILE, LABELS_FILE, WEATHER_FILE
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.weather_table import write_weather
from heatsplat.geometry.transforms import camera_entry

log = logging.getLogger("heatsplat")

SCENES, TRUTH = "scenes", "truth"  # the two folders: what is handed out, and what is not
META = "meta.json"


def write_scenes(
    output_dir: Path | str,
    protocol: Mapping[str, Any],
    target: str | None = None,
    size: str | None = None,
    scenes: Sequence[str] | None = None,
    real: Mapping[str, SceneDataModule] | None = None,
) -> None:
    """Writes the scenes of a protocol; those that are there already stay.

    Args:
        output_dir: folder of the study, which gets them where there is no ``target``.
        protocol: conf/protocol.
        target: folder that gets scenes/ and truth/.
        size: of synthetic scenes; None for the protocol's.
        scenes: names of those that are written; None for all.
        real: further scenes by name, as their data modules.

    Raises:
        SceneError: there is no such scene, or the folder holds scenes of another size, seed or other options.
    """
    target = Path(target or output_dir).expanduser()
    settings = {
        name: {"size": size or protocol["size"], "scene_seed": protocol["scene_seed"]}
        | {"options": {**entry["data"], "parts": {**protocol["parts"], **entry.get("parts", {})}}}
        for name, entry in protocol["scenes"].items()
    }
    known = {
        name: partial(Synthetic, split="parts", size=made["size"], scene_seed=made["scene_seed"], **made["options"])
        for name, made in settings.items()
    }
    known |= {name: partial(lambda module: module, module) for name, module in (real or {}).items()}
    if unknown := set(scenes or ()) - set(known):
        raise SceneError(f"study.scenes: there is no {', '.join(sorted(unknown))}; there are {', '.join(known)}")
    for name in scenes or known:
        made_from = {"protocol": protocol["version"], **({"size": None} if name in (real or {}) else settings[name])}
        folder = target / SCENES / name
        if _is_there(folder, made_from):
            log.info("%s is there already", folder)
            continue
        log.info("writing %s", folder)
        prefix = "near_" if name in (real or {}) else ""
        write_scene(known[name]().scene, folder, target / TRUTH / name, made_from, prefix)


def _is_there(folder: Path, made_from: Mapping[str, Any]) -> bool:
    """Whether a folder holds a scene. Raises SceneError where that was made from something else."""
    if not (folder / META).exists():
        return False
    before = json.loads((folder / META).read_text())
    if changed := [key for key, value in made_from.items() if before.get(key) != value]:
        raise SceneError(
            f"{folder} was written with another {' and '.join(changed)}: delete it, or give study.target another folder"
        )
    return True


def write_scene(scene: SceneData, folder: Path, truth: Path, also: Mapping[str, Any], prefix: str = "") -> None:
    """Writes one scene: cameras of all views, images of the training views alone; and the truth of the test views.

    meta.json is written last, so that what was stopped half-way is written anew.

    Args:
        folder: what is handed out.
        truth: what is not: float32 TIFF in °C by the name of the view, NaN where a pixel does not count; and images/.
        also: further keys of meta.json.
        prefix: what names of test views get, where they do not begin with the part that they belong to.

    Raises:
        SceneError: its images are no temperatures, or two would have one file.
    """
    if scene.thermal_range is None:
        raise SceneError(f"scene {scene.name} has no temperatures, and the protocol scores °C")
    _check_names(scene)
    for subset, views in (("train", scene.train), ("test", scene.test)):
        _write_views(scene, subset, views, folder, truth, prefix * (subset == "test"))
    _write_points(scene, folder)
    meta = {
        **also,
        "scene": scene.name,
        "min_value": scene.thermal_range.min_c,
        "max_value": scene.thermal_range.max_c,
        "ambient_c": scene.ambient_c,
        "metres_per_unit": scene.metres_per_unit,
    }
    if scene.weather is not None:
        write_weather(folder / WEATHER_FILE, scene.weather)
        notes = scene.weather.notes
        site = ("latitude", "longitude", "altitude_m", "up", "north")
        meta |= {key: notes[key] for key in site if key in notes} | {"utc_at_zero_s": notes.get("utc_at_zero_s")}
    if scene.true_attributes is not None:
        known = scene.true_attributes(scene.points)
        columns = (values.double().numpy() for values in known.values())
        table = np.stack([*scene.points.double().numpy().T, *columns], axis=1)
        head = ",".join(["x", "y", "z", *known])
        np.savetxt(truth / "materials.csv", table, fmt="%.7g", delimiter=",", header=head, comments="")
    _json(folder / META, meta)


def _check_names(scene: SceneData) -> None:
    """Raises SceneError where two images would have one file."""
    for views in (scene.train, scene.test):
        stems = Counter(Path(frame.name).stem for frame in views.frames)
        if twice := [frame.name for frame in views.frames if stems[Path(frame.name).stem] > 1]:
            raise SceneError(
                f"images of scene {scene.name} such as {twice[0]} and {twice[1]} have one name in several folders, and would be "
                "one file of the protocol; give them names of their own"
            )


def _write_views(scene: SceneData, subset: str, views: ViewSet, folder: Path, truth: Path, prefix: str) -> None:
    """The cameras of a subset, in ``folder``, and its images: as recorded in there for training, clean in ``truth`` for test."""
    frames = []
    for view in views:
        name = prefix + Path(view.frame.name).stem
        entry = {"file_path": f"images/{name}.png" if view.rgb is not None else f"thermal/{name}.tiff"}
        entry |= {"thermal_file_path": f"thermal/{name}.tiff", "time_s": view.time_s}
        frames.append(entry | camera_entry(view.camera))
        if subset == "train":
            _image(folder / "thermal" / f"{name}.tiff", _celsius(scene, view, "thermal"))
        else:
            _image(truth / f"{name}.tiff", _celsius(scene, view, "clean"))
        if view.rgb is not None:
            place = folder if subset == "train" else truth
            _image(place / "images" / f"{name}.png", (view.rgb.numpy() * 255.0).round().astype(np.uint8))
    _json(folder / FILES[subset], {"camera_model": "PINHOLE", "ply_file_path": "points3D.ply", "frames": frames})


def _write_points(scene: SceneData, folder: Path) -> None:
    """The points as PLY and, with the training cameras, as a model of COLMAP, and what is known of each."""
    points = scene.points.double().numpy()
    colors = np.full_like(points, 0.5) if scene.point_colors is None else scene.point_colors.double().numpy()
    colors = (colors * 255.0).round().astype(np.uint8)
    _ply(folder / "points3D.ply", points, colors)
    cameras = {f"{Path(frame.name).stem}.tiff": frame.camera for frame in scene.train.frames}
    kinds, camera_of = pinholes(cameras)
    poses = {name: camera.viewmat.numpy() for name, camera in cameras.items()}
    write_model(folder / "sparse" / "0", poses, kinds, points, colors, camera_of=camera_of)
    if scene.labels is not None:
        np.save(folder / LABELS_FILE, scene.labels.numpy())
    if scene.point_features is not None:
        np.save(folder / FEATURES_FILE, scene.point_features.numpy())


def _celsius(scene: SceneData, view: View, which: str) -> np.ndarray:
    celsius = scene.thermal_range.to_celsius(view.image(which)[..., 0].numpy().astype(np.float64)).astype(np.float32)
    return celsius if view.mask is None else np.where(view.mask.numpy(), celsius, np.float32(np.nan))


def _image(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path)


def _json(path: Path, values: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values, indent=1))


def _ply(path: Path, points: np.ndarray, colors: np.ndarray) -> None:
    kinds = [(axis, "f8") for axis in "xyz"] + [(band, "u1") for band in ("red", "green", "blue")]
    rows = np.empty(len(points), dtype=kinds)
    for i, axis in enumerate("xyz"):
        rows[axis] = points[:, i]
    for i, band in enumerate(("red", "green", "blue")):
        rows[band] = colors[:, i]
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))
