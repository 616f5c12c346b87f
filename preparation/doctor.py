"""The doctor on a folder: a scene that trains, or a camera's files that have no poses yet."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from heatsplat.contracts import SceneError, counted, evenly_spread
from heatsplat.datamodules.base import SceneDataModule
from heatsplat.datamodules.benchmark import Benchmark
from heatsplat.datamodules.benchmark_folder import META, SCENES, TRUTH
from heatsplat.datamodules.bounds import union
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.colmap import find_model
from heatsplat.datamodules.formats.images import read_bytes
from heatsplat.datamodules.nerfstudio import Nerfstudio, find_transforms
from heatsplat.datamodules.ntr import NTR
from heatsplat.datamodules.posed_frames import FILES
from heatsplat.datamodules.rgbt_scenes import RGBTScenes, is_paired
from heatsplat.datamodules.rhd import RHD
from heatsplat.datamodules.thermo import Thermo
from heatsplat.datamodules.timestamps import instant, zone_of
from heatsplat.doctor.base import MAX_FRAMES, Finding, Material, material_of
from heatsplat.doctor.examination import FINDINGS_FILE, examine, show, warn, write_findings
from heatsplat.preparation.devices import Device, devices_of
from heatsplat.preparation.frame import ThermalFrame
from heatsplat.preparation.frames import Reading, Recording, read_recording, reading_of
from heatsplat.preparation.makers import taken_at
from heatsplat.preparation.report import Section

log = logging.getLogger(__name__)

PROTOCOL_POINTS = "points3D.ply"  # of a scene of the leaderboard's protocol, whose meta.json is another one
# What loaders say of where numbers come from.
SOURCES = {
    "encoding": "values",
    "bounds_source": "temperature bounds",
    "time_source": "times",
    "points_source": "points",
}
QUARTER_S = 900.0  # zones lie whole quarters of an hour apart
LATER = "Drift, poses, focal length and what else needs cameras is looked at once they are known."
DONE = {"dead_pixels": "The masks of the prepared scene leave them out."}  # what a preparation does by itself


def check(
    folder: str,
    target: Path | None = None,
    downscale: float = 1.0,
    counts: Mapping[str, Any] | None = None,
    bounds_c: Sequence[float] | None = None,
    zone: str | None = None,
    table: str | None = None,
    table_columns: Mapping[str, str] | None = None,
    palette: str | None = None,
    palette_hot: str | None = None,
) -> list[Finding]:
    """Looks for what is wrong with a folder, prints a table of it, and writes it to doctor.json.

    Args:
        folder: a scene, or a camera's files.
        target: where doctor.json is written; None: in the working directory, where that takes files.
        downscale: factor by which images of a scene shrink before they are looked at.
        counts, bounds_c: of ``Meaning``, for a camera's files.
        zone, table, table_columns: of ``Reading``, for a camera's files.
        palette, palette_hot: of pictures in false colours, of a scene or a camera's files (``palette_of``).

    Raises:
        SceneError: the folder holds neither, or something is said of a camera's files and it is a scene.
    """
    told = {
        "zone": zone,
        "table": table,
        "table_columns": table_columns,
        "palette": palette,
        "palette_hot": palette_hot,
    }
    reading = reading_of(counts=counts, bounds_c=bounds_c, **told)
    materials, notes = materials_in(Path(folder).expanduser(), downscale, reading)
    said = {"bounds_c": bounds_c, "zone": zone, "table": table}
    said |= {f"counts.{name}": value for name, value in (counts or {}).items()}
    if "" in materials and (idle := [name for name, value in said.items() if value is not None]):
        raise SceneError(
            f"{idle[0]} changes nothing for the scene in {folder}: it is for a camera's files, leave it out"
        )
    for note in notes:
        log.info("%s", note)
    found = examined(materials)
    show(found, str(folder))
    if _more_with_cameras(materials, found):
        log.info("%s", LATER)
    path = (target or Path()) / FINDINGS_FILE
    try:
        write_findings(found, path)
    except OSError as error:
        if target is not None:
            raise
        log.warning("%s is not written, as this folder takes no files (%s): target=FOLDER gives another", path, error)
    else:
        log.info("%s", path)
    return found


def section(folder: Path, reading: Reading | None = None, recording: Recording | None = None) -> Section:
    """The part of a preparation's report on what is wrong with a folder, which is warned of, too; arguments as of
    ``materials_in``."""
    materials, _ = materials_in(folder, 1.0, reading, recording)
    posed, found = any(material.cameras is not None for material in materials.values()), examined(materials)
    if not posed:
        found = [replace(one, remedy=DONE.get(one.check, one.remedy)) for one in found]
    warn(found)
    lines = [f"{counted(len(found), 'finding')}, at the top of this page." if found else "Nothing found."]
    if _more_with_cameras(materials, found):
        lines += ["", LATER]
    findings = [f"**{one.check}**: {one.what} {one.remedy}" for one in found]
    return Section("Doctor", lines, {"findings": [vars(one) for one in found]}, findings)


def _more_with_cameras(materials: Mapping[str, Material], found: Sequence[Finding]) -> bool:
    """Whether a search for cameras would let more checks look; not where the camera stood still."""
    return all(one.cameras is None for one in materials.values()) and all(one.check != "still" for one in found)


def materials_in(
    folder: Path, downscale: float = 1.0, reading: Reading | None = None, recording: Recording | None = None
) -> tuple[dict[str, Material], list[str]]:
    """What there is to look at in a folder: a scene, called "", or the files of each thermal camera by its label; and what was
    taken for granted when the files were read; ``recording`` are these files where they have been read.

    Raises:
        SceneError: the folder holds neither scene nor recording.
    """
    if not folder.is_dir():
        raise SceneError(f"check={folder}: there is no such folder")
    reading = reading or Reading()
    if (loader := _loader_of(folder, downscale, reading)) is not None:
        return {"": material_of(loader.scene)}, _assumed(loader)
    if scenes := sorted(path.parent for path in (folder / SCENES).glob(f"*/{META}")):
        raise SceneError(
            f"{folder} holds {counted(len(scenes), 'scene')} of the protocol: give one, such as {scenes[0]}"
        )
    recording = recording or read_recording(folder, reading)
    devices = devices_of(recording.frames)
    notes = [f"{counted(len(device.frames), 'frame')} of {device.label}" for device in devices]
    return {device.label: _recorded(device, reading.zone) for device in devices}, [*notes, *recording.notes]


def examined(materials: Mapping[str, Material]) -> list[Finding]:
    """What is wrong with any of them, the most costly first; where there are several it is said of which."""
    found = [
        replace(one, what=f"{label}: {one.what}") if len(materials) > 1 else one
        for label, material in materials.items()
        for one in examine(material)
    ]
    return sorted(found, key=lambda one: -one.cost)


def _loader_of(folder: Path, downscale: float, reading: Reading) -> SceneDataModule | None:
    """What reads the scene in a folder, by its files; None where these are no scene.

    Layouts that look alike have other axes or bounds: the first that fits reads them. Where images lie beside a sparse model,
    counts, photos and times in folders and files of the usual names are taken.
    """

    def has(*names: str) -> bool:
        return all((folder / name).exists() for name in names)

    given = {"root": str(folder), "downscale": downscale}
    if reading.palette is not None:
        given |= {"palette": reading.palette, "palette_hot": reading.palette_hot}
    model, both = find_model(folder) is not None, has(*FILES.values())
    if both and has(META, PROTOCOL_POINTS):  # the training images alone where test images are not handed out
        return Benchmark(**given) if _truth_of(folder).is_dir() else Nerfstudio(split="every_8th", **given)
    if has("meta.json") and (model or both) and not has(PROTOCOL_POINTS):
        return Thermo(**given)
    if find_model(folder / "thermal") is not None or (model and has("info.json")):
        return RHD(**given)
    if both and has("mesh.obj"):
        return NTR(**given)
    if find_transforms(folder):  # a model beside it gives points alone
        return Nerfstudio(**given)
    if is_paired(folder) and not has("images"):
        return RGBTScenes(**given)
    usual = {"raw": "raw16", "rgb": "rgb", "time_csv": "times.csv"}
    return Colmap(**given, **{key: name for key, name in usual.items() if has(name)}) if model else None


def _truth_of(folder: Path) -> Path:
    """Where ``Benchmark`` looks for the test images of a scene of the protocol."""
    folder = folder.absolute()
    return folder.parent.parent / TRUTH / folder.name


def _assumed(loader: SceneDataModule) -> list[str]:
    """How a scene was read, a sentence for each thing."""
    notes = loader.scene.notes
    told = [f"read as data={type(loader).__module__.rpartition('.')[2]} reads it"]
    return told + [f"{SOURCES[name]}: {notes[name]}" for name in SOURCES if name in notes]


def _recorded(device: Device, zone: str | None) -> Material:
    """The files of a thermal camera, without poses."""
    frames = device.frames
    chosen = evenly_spread(len(frames), MAX_FRAMES)
    images = torch.from_numpy(np.stack([frames[i].pixels() for i in chosen])).double()
    known = all(frame.calibration is not None for frame in frames)
    spans = [frame.span for frame in frames if frame.span is not None]
    bounds = (union(spans).min_c, union(spans).max_c) if spans else _bounds_of_greys(frames[chosen[0]])
    if bounds is not None:
        images = (images - bounds[0]) / (bounds[1] - bounds[0])
    times = [None if frame.time is None else instant(frame.time) for frame in frames]
    return Material(
        names=[frame.name for frame in frames],
        times_s=None if any(time is None for time in times) else times,
        chosen=chosen,
        images=images,
        unit_k=bounds[1] - bounds[0] if bounds is not None else 1.0 if known else None,
        bounds_c=bounds,
        stored=_stored(frames[chosen[0]]),
        rgb_times_s=_photo_times(frames, zone),
    )


def _stored(frame: ThermalFrame) -> str:
    """What the files of a camera hold, as ``Material.stored`` has it."""
    if frame.calibration is not None and frame.calibration.scale is None:
        return "radiometric"
    if frame.span is not None:
        return "grey16" if frame.load().dtype == np.uint16 else "grey8"
    return {"u1": "grey8", "u2": "counts", "f4": "celsius"}.get(frame.load().dtype.str[1:], "")


def _bounds_of_greys(frame: ThermalFrame) -> tuple[float, float] | None:
    """°C of black and white where a frame is a grey of 8 bits with bounds; else None."""
    calibration = frame.calibration
    if calibration is None or calibration.scale is None or frame.load().dtype != np.uint8:
        return None
    return calibration.offset_c, calibration.offset_c + np.iinfo(np.uint8).max * calibration.scale


def _photo_times(frames: Sequence[ThermalFrame], zone: str | None) -> list[float] | None:
    """When photos were taken, on their camera's clock; None where one does not say.

    Where only one of the two clocks says its zone, the other is taken to be in the zone that brings them closest: whole
    quarters of an hour between them are no error of a clock.
    """
    found = []
    for frame in frames:
        taken = None if frame.rgb is None else taken_at(read_bytes(frame.rgb))
        if taken is None or frame.time is None:
            return None
        if taken.tzinfo is None and zone is not None:
            taken = taken.replace(tzinfo=zone_of(zone, "zone"))
        apart = instant(taken) - instant(frame.time)
        if (taken.tzinfo is None) != (frame.time.tzinfo is None):
            apart -= QUARTER_S * round(apart / QUARTER_S)
        found.append(instant(frame.time) + apart)
    return found or None
