"""Whose a folder is that a preparation writes into: nothing but what a preparation wrote itself is ever replaced."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from pathlib import Path

from heatsplat.contracts import SceneError
from heatsplat.datamodules.bounds import BOUNDS_FILE, BOUNDS_TABLE
from heatsplat.datamodules.colmap import FRAMES_FILE, WORLD_FILE
from heatsplat.io.files import read_json_object, write_atomically
from heatsplat.io.page import PAGE_FILE

RECORD = ".prepared"  # file in the folder: what wrote it, and a hash of the cameras that it wrote
PARTIAL = ".partial"  # folder of what is being written
WORK = ".poses"  # folder of copies, features and matches, from which a stopped search goes on
REPORT = "report.md"
CAMERAS = "sparse/0"
PREPARED, CORRECTED = "prepared from a camera's files", "corrected pixel by pixel"
FOLDERS = ("images", "masks", "counts", "visible", "report")
FILES = (FRAMES_FILE, BOUNDS_FILE, BOUNDS_TABLE, WORLD_FILE, REPORT, PAGE_FILE)


class Target:
    """A folder that is written into, once it is known that nothing is lost by it.

    Args:
        folder: that is written into.
        made: what it then is: ``PREPARED`` or ``CORRECTED``.
    """

    def __init__(self, folder: Path, made: str) -> None:
        self.folder, self.made = folder, made

    def claim(self, sources: Iterable[Path] = (), cameras: bool = True) -> None:
        """Writes down that the folder is ours.

        Args:
            sources: files that are read.
            cameras: whether sparse/0 is written, too.

        Raises:
            SceneError: one of the sources lies where is written, or the folder holds what nothing like this wrote.
        """
        written = {(self.folder / name).resolve() for name in (*FOLDERS, "sparse")}
        if lost := next((path for path in sources if not written.isdisjoint(path.resolve().parents)), None):
            raise SceneError(
                f"{lost} would be replaced: target={self.folder} writes into the folder that it is read from; give a target "
                "outside of it"
            )
        record = read_json_object(self.folder / RECORD)
        ours = wrote(self.folder) == self.made
        if not ours and (foreign := self._first()) is not None:
            raise SceneError(
                f"{foreign} is of something else than a scene {self.made}, and would be replaced; give an empty folder as "
                "target, or move it elsewhere"
            )
        place = self.folder / CAMERAS
        there = _digest(place)
        own = (record or {}).get("cameras")
        if cameras and there not in (None, own):
            raise SceneError(
                f"{place} holds cameras that no preparation wrote, or that were changed since, and they would be replaced; "
                "move them elsewhere, or give another target"
            )
        self._write(own)

    def has_cameras(self) -> None:
        """Writes down that the cameras in the folder are ours."""
        self._write(_digest(self.folder / CAMERAS))

    def _write(self, cameras: str | None) -> None:
        write_atomically(self.folder / RECORD, json.dumps({"made": self.made, "cameras": cameras}) + "\n")

    def _first(self) -> Path | None:
        """A file that would be replaced, or None."""
        files = [self.folder / name for name in FILES]
        inside = (path for name in FOLDERS for path in sorted((self.folder / name).rglob("*")))
        return next((path for path in (*inside, *files) if path.is_file()), None)


def wrote(folder: Path) -> str | None:
    """What a folder that was written here is: ``PREPARED`` or ``CORRECTED``; None of any other."""
    return (read_json_object(folder / RECORD) or {}).get("made")


def _digest(folder: Path) -> str | None:
    """A hash of the files in a folder, their names included; None where it has none."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    if not files:
        return None
    found = hashlib.sha256()
    for path in files:
        found.update(path.relative_to(folder).as_posix().encode())
        with path.open("rb") as file:
            found.update(hashlib.file_digest(file, "sha256").digest())
    return found.hexdigest()
