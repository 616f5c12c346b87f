"""The preparation of a recording, step by step."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from heatsplat.preparation.frames import Frame, read_frames
from heatsplat.preparation.report import Section

# How cameras are found: gets the frames and the prepared folder, whose images/ has a file for each frame, and writes sparse/0.
Poses = Callable[[list[Frame], Path], Section]
# What is wrong with the files of a folder (prepared or not), the most costly first.
Doctor = Callable[[Path], Section]


def prepare(source: Path, target: Path, doctor: Doctor | None, poses: Poses | None) -> list[Section]:
    """Makes of a camera's files in ``source`` the scene ``target``; returns the sections of its report."""
    sections = [doctor(source)] if doctor else []
    frames = read_frames(source)
    if poses:
        sections.append(poses(frames, target))
    return sections
