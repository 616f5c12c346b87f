"""From a camera's files to a folder that trains: python src/prepare.py source=FOLDER target=FOLDER."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from rich.progress import track

from heatsplat.contracts import SceneError, counted
from heatsplat.io.command_lines import setting, typed
from heatsplat.preparation import report
from heatsplat.preparation.conditions import GivenConditions, InputUncertainty
from heatsplat.preparation.devices import devices_of, listed
from heatsplat.preparation.frame import ThermalFrame
from heatsplat.preparation.frames import Reading, Recording, read_recording, reading_of
from heatsplat.preparation.report import Section
from heatsplat.preparation.target import PREPARED, Target
from heatsplat.preparation.writer import Writer

log = logging.getLogger(__name__)

# How cameras are found: gets the frames and the prepared folder, whose images/ has a file for each frame, and writes sparse/0.
Poses = Callable[[list[ThermalFrame], Path], Section]
# What is wrong with the files of a folder (prepared or not), read as they are here, the most costly first; the frames in it where
# they have been read.
Doctor = Callable[[Path, Reading, Recording | None], Section]


def prepare(
    source: str,
    target: Path,
    *,
    conditions: Mapping[str, float | None],
    uncertainty: Mapping[str, float],
    counts: Mapping[str, Any],
    bounds_c: Sequence[float] | None = None,
    band_um: Sequence[float] = (7.5, 14.0),
    zone: str | None = None,
    table: str | None = None,
    table_columns: Mapping[str, str] | None = None,
    every: int = 1,
    sharpest: bool = False,
    palette: str | None = None,
    palette_hot: str | None = None,
    keep_counts: bool = False,
    doctor: Doctor | None = None,
    poses: Poses | None = None,
) -> Path:
    """Makes of a camera's files a scene that trains, and returns the path of its report.

    The folder then has images/ (float32 TIFF in °C, each with a .json of all that is known of it), masks/ where pixels are
    dead, frames.csv (times, places), temperature_bounds.json (or .csv), report.md, report.html, and what ``poses`` adds. Nothing
    in ``source`` is changed.

    Args:
        source: folder of the camera's files.
        target: folder of the scene; what a preparation that was stopped left there is used.
        conditions: arguments of ``GivenConditions``; None takes those of the files.
        uncertainty: arguments of ``InputUncertainty``.
        counts: ``scale``, ``offset_c`` and ``planck`` of ``Meaning``.
        bounds_c, band_um: of ``Meaning``.
        zone, table, table_columns, every, sharpest, palette, palette_hot: of ``Reading``.
        keep_counts: also write the numbers as the camera stored them.
        doctor: looks at the folder first, and at the scene once it has cameras, or None.
        poses: finds the cameras, or None.

    Raises:
        SceneError: what is in the folder cannot be read, a setting changes nothing, ``target`` lies in ``source`` or holds what
            no preparation wrote, or no cameras can be found; the temperatures and the report are then written all the same.
    """
    folder = Path(source).expanduser().resolve()
    if not folder.is_dir():
        what = "this is a file; give the folder that it lies in" if folder.is_file() else "there is no such folder"
        raise SceneError(f"source={source}: {what}")
    if folder == target.resolve() or folder in target.resolve().parents:
        raise SceneError(f"target={target} lies in source={folder}; give a folder outside of it")
    given, uncertain = GivenConditions(**conditions), InputUncertainty(**uncertainty)
    reading = reading_of(
        counts=counts,
        bounds_c=bounds_c,
        band_um=band_um,
        zone=zone,
        table=table,
        table_columns=table_columns,
        every=every,
        sharpest=sharpest,
        palette=palette,
        palette_hot=palette_hot,
    )
    found = read_recording(folder, reading)
    for note in found.notes:
        log.info("%s", note)
    if len(devices := devices_of(found.frames)) > 1:
        log.warning(
            "%d thermal cameras, each with a lens and dead pixels of its own: %s", len(devices), listed(devices)
        )
    sections = [doctor(folder, reading, found)] if doctor else []
    frames = [given.settled(frame) for frame in found.frames]
    given.check_use(frames)
    writer = Writer(target, uncertain, keep_counts)
    writer.check(frames)
    place = Target(target, PREPARED)
    place.claim([path for frame in frames for path in (frame.path, frame.rgb) if path], poses is not None)
    dead = writer.find_dead_pixels(frames)
    records, fresh = [], 0
    for frame in track(frames, "radiometry"):
        record, written = writer.write(frame)
        records.append(record)
        fresh += written
    writer.finish(frames, records)
    writer.write_masks(frames)
    there = len(frames) - fresh
    log.info("%s%s", counted(len(frames), "frame"), f", {there} of them were there already" if there else "")
    frames = [replace(f, rgb=writer.photo_of(f)) if writer.photo_of(f).exists() else f for f in frames]
    notes = [*found.notes, *([f"{dead} pixels of the detector are dead; masks/ leaves them out"] if dead else [])]
    parts = [
        report.recording(frames, records, notes, given.doubts()),
        report.radiometry(frames, records, uncertain),
        report.pictures(target, frames, records),
    ]
    for section in filter(None, parts):
        sections.append(section)
        for finding in section.findings:
            log.warning("%s", finding)
    if poses:
        scene = replace(reading, palette=None, palette_hot=None)  # whose images are temperatures by now
        sections += _cameras(poses, partial(doctor, target, scene, None) if doctor else None, frames, place, sections)
    page = report.write_report(target, sections)
    log.info("%s", page.with_suffix(".html"))
    return page


def _cameras(
    poses: Poses,
    doctor: Callable[[], Section] | None,
    frames: list[ThermalFrame],
    place: Target,
    before: Sequence[Section],
) -> list[Section]:
    """What became of the cameras, and what the doctor sees with them. Where there are none the report says why."""
    target = place.folder
    report.write_report(target, before)  # a search may be stopped
    try:
        found = poses(frames, target)
    except SceneError as error:
        report.write_report(target, [*before, Section("Poses", [f"**{error}.**"])])
        what = "images" if all(frame.calibration is None for frame in frames) else "temperatures"  # greys have none
        raise SceneError(
            f"{error}. The {what} are in {target / 'images'} all the same (poses=none leaves out the search)"
        ) from error
    finally:
        place.has_cameras()
    log.info("%s", found.lines[0])
    for finding in found.findings:
        log.warning("%s", finding)
    sections = [found, replace(doctor(), title="Doctor, with the cameras")] if doctor else [found]
    log.info("it trains: python src/train.py data=colmap %s", typed(setting("data.root", target)))
    return sections
