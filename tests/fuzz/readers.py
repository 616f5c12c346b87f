"""Every reader of scenes on damaged scenes: it loads them sanely or says which file or key is wrong, and nothing else.

``make fuzz`` runs it for an hour: ``python tests/fuzz/readers.py SECONDS [LAYOUT NUMBER]``, with a number to repeat one.
"""

from __future__ import annotations

import json
import logging
import shutil
import struct
import sys
import traceback
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2  # noqa: F401, I001  (before pycolmap)
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "datamodules"))

from camera_files import flir_jpeg, raw_for, temperatures
from layouts import names, points, write_colmap
from mutate import Outcome, campaign, damaged_copy, guarded
from scene_files import LAYOUTS

from heatsplat.contracts import SceneData, SceneError
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.colmap import find_model
from heatsplat.datamodules.nerfstudio import Nerfstudio
from heatsplat.datamodules.ntr import NTR
from heatsplat.datamodules.rgbt_scenes import RGBTScenes
from heatsplat.datamodules.rhd import RHD
from heatsplat.datamodules.synthetic_scene.film import SIZES, film
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.datamodules.thermo import Thermo
from heatsplat.datamodules.thermoscenes import ThermoScenes
from heatsplat.datamodules.ti_nsd import TINSD

FRAMES = 9
READERS: dict[str, Callable] = {
    "colmap": partial(Colmap, time_csv="times.csv", rgb="rgb", ambient_c=20.0),
    "colmap_counts": partial(Colmap, raw="raw16", time_csv="times.csv"),
    "colmap_text": partial(Colmap, split="list", split_file="split.json"),
    "colmap_radiometric": partial(Colmap, radiometric="auto"),
    "rhd": RHD,
    "thermoscenes": partial(ThermoScenes, random_points=20),
    "thermoscenes_ply": partial(ThermoScenes, random_points=20),
    "nerfstudio": partial(Nerfstudio, random_points=20),
    "photos": partial(Nerfstudio, random_points=20),
    "ti_nsd": TINSD,
    "rgbt_scenes": RGBTScenes,
    "ntr": partial(NTR, min_c=10.0, max_c=60.0, random_points=20),
    "thermo": partial(Thermo, random_points=20),
}


def write_templates(root: Path) -> None:
    """A small whole scene in each layout: root/<layout>."""
    recording = film(Scene(PRESETS["cooling"]), replace(SIZES["tiny"], width=24, height=20, frames=FRAMES, points=30))
    for name, write in LAYOUTS.items():
        write(recording, root / name)
    shutil.copytree(root / "colmap", root / "colmap_counts")
    mask = np.full((20, 24), 255, np.uint8)
    mask[:5] = 0
    for i in range(3):
        (root / "colmap" / "masks").mkdir(exist_ok=True)
        assert cv2.imwrite(str(root / "colmap" / "masks" / f"frame_{i:05d}.png"), mask)

    write_colmap(root / "colmap_text", names(FRAMES), text=True)
    (root / "colmap_text" / "split.json").write_text(json.dumps({"test": names(FRAMES)[::4]}))

    write_colmap(root / "colmap_radiometric", names(FRAMES, "f_{}.jpg"), images=None)
    for i, name in enumerate(names(FRAMES, "f_{}.jpg")):
        path = root / "colmap_radiometric" / "images" / name
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(flir_jpeg(raw_for(temperatures(i)), png=i % 2 == 0))

    ply = shutil.copytree(root / "thermoscenes", root / "thermoscenes_ply")
    if (model := find_model(ply)) is not None:
        shutil.rmtree(model)
    header = ["ply", "format binary_little_endian 1.0", "element vertex 30", *(f"property float {a}" for a in "xyz")]
    header += [f"property uchar {c}" for c in ("red", "green", "blue")]
    body = b"".join(struct.pack("<fff3B", *p, 9, 99, 200) for p in points(30))
    (ply / "points.ply").write_bytes("\n".join([*header, "end_header\n"]).encode() + body)
    transforms = next(ply.glob("transforms*.json"))
    transforms.write_text(json.dumps({**json.loads(transforms.read_text()), "ply_file_path": "points.ply"}))

    other_keys = {"file_path": "rgb", "thermal_file_path": "thermal"}
    nerfstudio = shutil.copytree(ply, root / "nerfstudio")
    transforms = next(nerfstudio.glob("transforms*.json"))
    values = json.loads(transforms.read_text())
    values["frames"] = [{other_keys.get(key, key): v for key, v in frame.items()} for frame in values["frames"]]
    transforms.write_text(json.dumps(values))

    photos = shutil.copytree(root / "ntr", root / "photos")
    for i, path in enumerate(sorted(photos.rglob("*.png"))):
        assert cv2.imwrite(str(path), np.random.default_rng(i).integers(0, 256, (20, 24, 3)).astype(np.uint8))

    thermo = root / "thermo"
    frames = [json.loads(path.read_text())["frames"] for path in sorted(thermo.glob("transforms_*.json"))]
    last = max(frame["time"] for part in frames for frame in part)
    rows = [f"2024-07-11T{6 + i:02d}:00:00Z;{20 + i},5;1,5;40;{100 * i}" for i in range(int(last // 3600) + 3)]
    columns = "utc;Air temperature [°C];wind_m_s;humidity_percent;GHI (W/m²)"
    (thermo / "weather.csv").write_text("\n".join([columns, *rows]) + "\n")
    meta = json.loads((thermo / "meta.json").read_text())
    place = {"latitude": 50.0, "longitude": 9.0, "altitude_m": 100.0, "up": [0, 0, 1], "north": [0, 1, 0]}
    (thermo / "meta.json").write_text(json.dumps({**meta, **place, "start_utc": "2024-07-11T06:00:00Z"}))
    count = len(recording.points)
    np.save(thermo / "labels.npy", np.arange(count) % 3)
    np.save(thermo / "space_features.npy", np.ones((count, 2), np.float32))


def nonsense(scene: SceneData) -> str:
    """What cannot be in a scene that was read, or nothing."""
    frames = [*scene.train.frames, *scene.test.frames]
    for view in [*scene.train, *scene.test]:
        camera, image = view.camera, view.image("thermal" if view.thermal is not None else "rgb")
        turned = camera.viewmat[:3, :3] @ camera.viewmat[:3, :3].T
        if image.shape[:2] != (camera.height, camera.width) or not ((image >= 0) & (image <= 1)).all():
            return f"image of {view.frame.name}"
        if view.rgb is not None and not ((view.rgb >= 0) & (view.rgb <= 1)).all():
            return f"visible image of {view.frame.name}"
        if not camera.viewmat.isfinite().all() or (turned - np.eye(3)).abs().max() > 2e-3:
            return f"pose of {view.frame.name}"
        if not camera.K.isfinite().all() or camera.K[0, 0] <= 0 or camera.K[1, 1] <= 0:
            return f"lens of {view.frame.name}"
    times = [frame.time_s for frame in frames]
    if any(t is not None and not np.isfinite(t) for t in times):
        return "times"
    for name in ("points", "point_colors", "point_features"):
        values = getattr(scene, name)
        if values is not None and not values.isfinite().all():
            return name
    if not 0 < scene.extent < 1e13 or not np.isfinite(scene.bulk[1]):
        return "extent"
    bounds = scene.thermal_range
    if bounds is not None and not -273.15 <= bounds.min_c < bounds.max_c <= 1e4:
        return "bounds"
    if scene.ambient_c is not None and not -273.15 <= scene.ambient_c <= 1e4:
        return "ambient"
    json.dumps(scene.notes, allow_nan=False)
    return ""


def outcome_of(layout: str, template: Path, place: Path, number: int) -> Outcome:
    """Damages a copy of the template by the number and reads it, in a process of its own."""
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    known = (
        {p.name for p in template.rglob("*")} | {p.stem for p in template.rglob("*")} | {"data.", "frame ", "scene "}
    )
    done = "; ".join(damaged_copy(template, place, number))
    options = {"root": str(place)}
    if layout == "colmap_text":
        options["split_file"] = str(place / "split.json")
    try:
        reader = READERS[layout]
        scene = (reader(**options) if layout != "colmap_text" else Colmap(split="list", **options)).scene
        wrong = nonsense(scene)
        return Outcome(number, "nonsense", f"{wrong} ({done})") if wrong else Outcome(number, "loads", done)
    except (SceneError, FileNotFoundError) as error:
        named = any(word in str(error) for word in known)
        return Outcome(number, "refused" if named else "unnamed", f"{error} ({done})")
    except BaseException:
        return Outcome(number, "traceback", f"{traceback.format_exc(limit=-4)} ({done})")


def fuzzed(layout: str, root: Path, place: Path, numbers: range) -> list[Outcome]:
    """Outcomes of the inputs of one layout with these numbers."""
    return list(guarded(numbers, partial(outcome_of, layout, root / layout, place)))


if __name__ == "__main__":
    sys.exit(campaign(READERS, write_templates, fuzzed, sys.argv[1:]))
