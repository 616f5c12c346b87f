"""From a camera's files to a folder that trains: python src/prepare.py source=FOLDER target=FOLDER."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.progress import track

from heatsplat.contracts import SceneError
from heatsplat.preparation import report
from heatsplat.preparation.conditions import Given, Uncertainty
from heatsplat.preparation.frame import Frame
from heatsplat.preparation.frames import Reading, read_recording
from heatsplat.preparation.meaning import Meaning
from heatsplat.preparation.report import Section
from heatsplat.preparation.writer import Writer

log = logging.getLogger(__name__)

# How cameras are found: gets the frames and the prepared folder, whose images/ has a file for each frame, and writes sparse/0.
Poses = Callable[[list[Frame], Path], Section]
# What is wrong with the files of a folder (prepared or not), the most costly first.
Doctor = Callable[[Path], Section]


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
    keep_counts: bool = False,
    doctor: Doctor | None = None,
    poses: Poses | None = None,
) -> Path:
    """Makes of a camera's files a scene that trains, and returns the path of its report.

    The folder then has images/ (float32 TIFF in °C, each with a .json of all that is known of it), masks/ where pixels are
    dead, frames.csv (times, places), temperature_bounds.json, report.md, and what ``poses`` adds. Nothing in ``source`` is
    changed.

    Args:
        source: folder of the camera's files.
        target: folder of the scene; what a preparation that was stopped left there is used.
        conditions: arguments of ``Given``; None takes those of the files.
        uncertainty: arguments of ``Uncertainty``.
        counts: ``scale``, ``offset_c`` and ``planck`` of ``Meaning``.
        bounds_c, band_um: of ``Meaning``.
        zone, table, table_columns: of ``Reading``.
        keep_counts: also write the numbers as the camera stored them.
        doctor: looks at the folder first, or None.
        poses: finds the cameras, or None.

    Raises:
        SceneError: what is in the folder cannot be read, or ``target`` lies in ``source``.
    """
    folder = Path(source).expanduser().resolve()
    if not folder.is_dir():
        raise SceneError(f"source={source}: there is no such folder")
    if folder == target.resolve() or folder in target.resolve().parents:
        raise SceneError(f"target={target} lies in source={folder}; give a folder outside of it")
    given, uncertain = Given(**conditions), Uncertainty(**uncertainty)
    reading = Reading(
        Meaning(**counts, bounds_c=bounds_c, band_um=band_um),
        zone,
        Path(table).expanduser() if table else None,
        table_columns or {},
    )
    sections = [doctor(folder)] if doctor else []
    found = read_recording(folder, reading)
    frames = [given.settled(frame) for frame in found.frames]
    writer = Writer(target, uncertain, keep_counts)
    writer.check(frames)
    dead = writer.find_dead_pixels(frames)
    records, fresh = [], 0
    for frame in track(frames, "radiometry"):
        record, written = writer.write(frame)
        records.append(record)
        fresh += written
    writer.finish(frames, records)
    writer.write_masks(frames)
    log.info("%d frames, %d of them written now, the others were there", len(frames), fresh)
    frames = [replace(f, rgb=writer.photo_of(f)) if writer.photo_of(f).exists() else f for f in frames]
    notes = [*found.notes, *([f"{dead} pixels of the detector are dead; masks/ leaves them out"] if dead else [])]
    parts = [
        report.recording(frames, records, notes),
        report.radiometry(frames, records, uncertain),
        report.pictures(target, frames, records),
    ]
    sections += [part for part in parts if part is not None]
    page = report.write_report(target, sections)  # there already, should the cameras not be found
    if poses:
        page = report.write_report(target, [*sections, poses(frames, target)])
    log.info("%s", page)
    return page
