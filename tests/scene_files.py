"""Writes a recording to disk in the layout of each data set, exactly as its loader would meet it.

Every writer takes a recording and the folder of one scene, which it makes. What a layout cannot say (times in
ThermoScenes, temperatures in TI-NSD and RGBT-Scenes) is lost, as it is in the data set. ``LAYOUTS`` lists them by name.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from matplotlib import colormaps
from PIL import Image

from heatsplat.datamodules.formats.colmap import write_model
from heatsplat.datamodules.synthetic_scene.film import Recording
from heatsplat.datamodules.synthetic_scene.outdoor import training_frames
from heatsplat.datamodules.weather_table import utc_text, write_weather
from heatsplat.geometry.transforms import OPENGL_AXES
from heatsplat.physics.units import KELVIN_AT_0_C

# What nerfstudio does to COLMAP's world: it swaps x and y and turns z round.
APPLIED_TRANSFORM = ((0.0, 1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, -1.0, 0.0))
# A raw count of a DJI M3T camera is this many kelvin.
KELVIN_PER_COUNT = 1.0 / 64.0
# ThermalGaussian's files are coloured by an iron palette; this is the nearest one at hand.
PALETTE = "inferno"


def write_rhd(recording: Recording, folder: Path, clock_s: float = 15 * 3600 + 38 * 60 + 24.0) -> None:
    """RHD: thermal/images/HHMMSSmmm.png (three equal channels), thermal/sparse/0, thermal/info.json, and rgb/ likewise.

    Args:
        clock_s: seconds since midnight at which the record started; it may run past midnight.
    """
    names = [f"{clock_digits(clock_s + time)}.png" for time in recording.times_s]
    for frame, name in enumerate(names):
        _png(folder / "thermal" / "images" / name, _three_channels(recording.grey(frame)))
        _png(folder / "rgb" / "images" / name, recording.rgb[frame])
    _sparse(folder / "thermal" / "sparse" / "0", recording, names)
    _sparse(folder / "rgb" / "sparse" / "0", recording, names)
    bounds = recording.thermal_range
    _json(
        folder / "thermal" / "info.json",
        {"T_env": recording.scene.preset.ambient_c, "min_value": bounds.min_c, "max_value": bounds.max_c},
    )


def write_thermoscenes(recording: Recording, folder: Path) -> None:
    """ThermoScenes: nerfstudio JSON with OpenGL poses and lens distortion, greys between bounds.

    Every 8th frame is eval. The points lie in colmap/sparse/0, in the world before applied_transform.
    """
    counts = {"train": 0, "eval": 0}
    stems = []
    for frame in range(len(recording.times_s)):
        subset = "eval" if frame % 8 == 0 else "train"
        counts[subset] += 1
        stems.append(f"frame_{subset}_{counts[subset]:05d}")
    turn = np.vstack([APPLIED_TRANSFORM, [0.0, 0.0, 0.0, 1.0]])
    frames = []
    for frame, stem in enumerate(stems):
        _png(folder / "thermal" / f"{stem}.PNG", recording.grey(frame))
        _png(folder / "images" / f"{stem}.png", recording.rgb[frame])
        frames.append(
            {
                "file_path": f"images/{stem}.png",
                "thermal_file_path": f"thermal/{stem}.PNG",
                "transform_matrix": (turn @ np.linalg.inv(recording.viewmats[frame]) @ OPENGL_AXES).tolist(),
                "colmap_im_id": frame + 1,
            }
        )
    lens = recording.lens
    k1, k2, p1, p2 = lens.distortion or (0.0, 0.0, 0.0, 0.0)
    _json(
        folder / "transforms_thermal.json",
        {
            "camera_model": "OPENCV",
            "w": lens.width,
            "h": lens.height,
            "fl_x": lens.fx,
            "fl_y": lens.fy,
            "cx": lens.cx,
            "cy": lens.cy,
            "k1": k1,
            "k2": k2,
            "p1": p1,
            "p2": p2,
            "applied_transform": APPLIED_TRANSFORM,
            "frames": frames,
        },
    )
    _bounds(folder, recording)
    _sparse(folder / "colmap" / "sparse" / "0", recording, [f"{stem}.png" for stem in stems])


def write_ti_nsd(recording: Recording, folder: Path) -> None:
    """TI-NSD: images/<integer>.png and sparse/0. The integers are milliseconds (``data.seconds_per_frame=0.001``)."""
    names = [f"{round(1000 * time):08d}.png" for time in recording.times_s]
    for frame, name in enumerate(names):
        _png(folder / "images" / name, _three_channels(recording.grey(frame)))
    _sparse(folder / "sparse" / "0", recording, names)


def write_colmap(recording: Recording, folder: Path) -> None:
    """One's own recording: images/ (8 bit), raw16/ (counts of 1/64 K), rgb/, sparse/0, bounds and times.csv.

    ``data.raw=raw16`` reads the counts, ``data.time_csv=times.csv`` the times.
    """
    names = [f"frame_{frame:05d}.png" for frame in range(len(recording.times_s))]
    for frame, name in enumerate(names):
        counts = np.rint((recording.celsius[frame].astype(np.float64) + KELVIN_AT_0_C) / KELVIN_PER_COUNT)
        _png(folder / "images" / name, recording.grey(frame))
        _png(folder / "raw16" / name, counts.astype(np.uint16))
        _png(folder / "rgb" / name, recording.rgb[frame])
    _sparse(folder / "sparse" / "0", recording, names)
    _bounds(folder, recording)
    with (folder / "times.csv").open("w", newline="") as file:
        csv.writer(file).writerows(
            [("file", "time_s"), *((n, f"{t:.3f}") for n, t in zip(names, recording.times_s, strict=True))]
        )


def write_rgbt_scenes(recording: Recording, folder: Path) -> None:
    """RGBT-Scenes: rgb/ and pseudo-colour thermal/, each with train/ and test/ (every 8th frame), and one sparse/0."""
    palette = (colormaps[PALETTE](np.arange(256))[:, :3] * 255.0).round().astype(np.uint8)
    names = [f"img_{frame:03d}.png" for frame in range(len(recording.times_s))]
    for frame, name in enumerate(names):
        subset = "test" if frame % 8 == 0 else "train"
        _png(folder / "thermal" / subset / name, palette[recording.grey(frame)])
        _png(folder / "rgb" / subset / name, recording.rgb[frame])
    _sparse(folder / "sparse" / "0", recording, names)


def write_ntr(recording: Recording, folder: Path) -> None:
    """NTR: transforms_{train,test}.json with OpenCV poses, RGBA greys, mesh.obj; every 8th frame is test.

    The layout has no bounds: ``data.min_c``, ``data.max_c`` and ``data.ambient_c`` must be given when it is read.
    """
    lens = recording.lens
    if lens.is_distorted or lens.fx != lens.fy:
        raise ValueError("the NTR layout knows square pixels without distortion only")
    frames: dict[str, list[dict[str, Any]]] = {"train": [], "test": []}
    for frame, time in enumerate(recording.times_s):
        subset = "test" if frame % 8 == 0 else "train"
        path = f"./{subset}/{frame:04d}"
        grey = _three_channels(recording.grey(frame))
        _png(folder / f"{path}.png", np.concatenate([grey, np.full_like(grey[..., :1], 255)], axis=2))
        frames[subset].append(
            {
                "file_path": path,
                "transform_matrix": np.linalg.inv(recording.viewmats[frame]).tolist(),
                "time": float(time),
            }
        )
    angle = 2.0 * float(np.arctan(0.5 * lens.width / lens.fx))
    for subset, listed in frames.items():
        _json(folder / f"transforms_{subset}.json", {"camera_angle_x": angle, "frames": listed})
    (folder / "mesh.obj").write_text("".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in recording.points.tolist()))


def write_thermo(recording: Recording, folder: Path) -> None:
    """Our layout for Thermo: NTR's poses, 16-bit greys, meta.json, and weather.csv and labels.npy of outdoor scenes.

    Outdoors the frames of the first day train and those of the second test; elsewhere every 8th frame is test.
    """
    lens, weather, bounds = recording.lens, recording.scene.weather, recording.thermal_range
    if lens.is_distorted or lens.fx != lens.fy:
        raise ValueError("the thermo layout knows square pixels without distortion only")
    count = len(recording.times_s)
    first_day = training_frames(count)
    start_s = 0.0 if weather is None else weather.notes["utc_at_zero_s"]
    frames: dict[str, list[dict[str, Any]]] = {"train": [], "test": []}
    for frame, time in enumerate(recording.times_s):
        is_test = frame % 8 == 0 if weather is None else frame >= first_day
        subset = "test" if is_test else "train"
        path = f"./{subset}/{frame:04d}"
        _png(folder / f"{path}.png", recording.grey(frame, np.uint16))
        when = {"time": float(time)} if weather is None else {"utc": utc_text(start_s + float(time))}
        frames[subset].append(
            {"file_path": path, "transform_matrix": np.linalg.inv(recording.viewmats[frame]).tolist(), **when}
        )
    angle = 2.0 * float(np.arctan(0.5 * lens.width / lens.fx))
    for subset, listed in frames.items():
        _json(folder / f"transforms_{subset}.json", {"camera_angle_x": angle, "frames": listed})
    (folder / "mesh.obj").write_text("".join(f"v {x!r} {y!r} {z!r}\n" for x, y, z in recording.points.tolist()))
    meta = {"min_value": bounds.min_c, "max_value": bounds.max_c, "metres_per_unit": 1.0}
    if weather is None:
        meta["ambient_c"] = recording.scene.preset.ambient_c
    else:
        meta |= {key: weather.notes[key] for key in ("latitude", "longitude", "altitude_m", "up", "north")}
        write_weather(folder / "weather.csv", weather)
        np.save(folder / "labels.npy", recording.scene.labels(torch.from_numpy(recording.points)).numpy())
    _json(folder / "meta.json", meta)


LAYOUTS: dict[str, Callable[[Recording, Path], None]] = {
    "rhd": write_rhd,
    "thermoscenes": write_thermoscenes,
    "ti_nsd": write_ti_nsd,
    "colmap": write_colmap,
    "rgbt_scenes": write_rgbt_scenes,
    "ntr": write_ntr,
    "thermo": write_thermo,
}


def clock_digits(seconds: float) -> str:
    """HHMMSSmmm of seconds since some midnight, rounded to milliseconds; the day is lost."""
    milliseconds = round(1000 * seconds)
    s = milliseconds // 1000
    return f"{s // 3600 % 24:02d}{s // 60 % 60:02d}{s % 60:02d}{milliseconds % 1000:03d}"


def _png(path: Path, pixels: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, format="PNG", compress_level=1)


def _json(path: Path, values: dict[str, Any]) -> None:
    path.write_text(json.dumps(values, indent=1))


def _three_channels(grey: np.ndarray) -> np.ndarray:
    return np.repeat(grey[..., None], 3, axis=2)


def _bounds(folder: Path, recording: Recording) -> None:
    _json(
        folder / "temperature_bounds.json",
        {
            "absolute_max_temperature": recording.thermal_range.max_c,
            "absolute_min_temperature": recording.thermal_range.min_c,
        },
    )


def _sparse(folder: Path, recording: Recording, names: Sequence[str]) -> None:
    lens = recording.lens
    model = "OPENCV" if lens.distortion else "PINHOLE"
    write_model(
        folder,
        dict(zip(names, recording.viewmats, strict=True)),
        [(model, (lens.fx, lens.fy, lens.cx, lens.cy, *lens.distortion), lens.width, lens.height)],
        recording.points,
        np.rint(recording.point_colors * 255.0).astype(np.uint8),
    )
