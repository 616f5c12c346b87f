"""Where the times of a scene's images come from: a table, their names, or what lies beside them."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from heatsplat.contracts import SceneError, counted
from heatsplat.datamodules.file_names import same_files
from heatsplat.datamodules.side_files import found_file, read_table
from heatsplat.datamodules.timestamps import (
    dji_time,
    is_of_day,
    time_by_pattern,
    times_from_csv,
    unrolled_midnight,
)

log = logging.getLogger(__name__)

FRAMES_FILE = "frames.csv"  # of a prepared folder: file, time_s and more of each frame


@dataclass(frozen=True)
class FrameTimes:
    """The first of: a table, a pattern, what the file with the poses says, the frames.csv of a prepared folder, DJI names; none.

    Args:
        time_regex: picks the time out of an image name (first group), or None.
        time_format: strptime format of it, and of the times in ``time_csv``, HHMMSSmmm, or None for a number of seconds (in the
            table also ISO date-times).
        time_csv: table of times, relative to the scene or the working directory, or None.
        time_csv_name, time_csv_time: its columns of image names and of times.
    """

    time_regex: str | None = None
    time_format: str | None = None
    time_csv: str | None = None
    time_csv_name: str = "file"
    time_csv_time: str = "time_s"

    @property
    def are_told(self) -> bool:
        """Whether a table or a pattern says them, and nothing else is asked."""
        return bool(self.time_csv or self.time_regex)

    def of(
        self, folder: Path, names: Sequence[str], written: Mapping[str, float] | None = None, where: str = ""
    ) -> tuple[Mapping[str, float] | None, str]:
        """Seconds by image name, None without any, and a note on where they come from.

        Args:
            folder: of the scene.
            names: of its images.
            written: what the file with the poses says, of every image; None where it has none.
            where: that is.

        Raises:
            SceneError: the table or the pattern that was asked for does not have the time of an image.
        """
        if self.time_csv:
            return self._table(folder, names)
        if self.time_regex:
            told = f"file names, {self.time_regex} as {self.time_format or 'seconds'}"
            return self._past_midnight(
                {name: time_by_pattern(name, self.time_regex, self.time_format) for name in names}, told
            )
        if written is not None:
            return written, where
        path, told = folder / FRAMES_FILE, ""  # without times where a frame had none
        if path.is_file() and "time_s" in read_table(path).columns:
            times = _looked_up(times_from_csv(path, "file", "time_s"), names, path)
            if len(times) == len(names):
                return times, path.name
            lacking = next(name for name in names if name not in times)
            told = f"{path.name} has those of {len(times)} of {counted(len(names), 'image')}, and none of {lacking}"
        of_names = {name: time for name in names if (time := dji_time(name)) is not None}
        if len(of_names) == len(names):
            return of_names, "DJI file names (whole seconds, the camera's clock)"
        if told:
            log.warning("times are left out: %s; add a row for each image", told)
        return None, f"none ({told or 'set data.time_regex or data.time_csv'})"

    def _table(self, folder: Path, names: Sequence[str]) -> tuple[Mapping[str, float], str]:
        path = found_file("data.time_csv", self.time_csv, folder)
        table = times_from_csv(path, self.time_csv_name, self.time_csv_time, self.time_format)
        times = _looked_up(table, names, path)
        if missing := [name for name in names if name not in times]:
            raise SceneError(
                f"data.time_csv: {path} has no row for {missing[0]} ({len(missing)} of {len(names)} images); "
                f"column {self.time_csv_name} must hold the image names"
            )
        return self._past_midnight(times, f"{path.name}, column {self.time_csv_time}")

    def _past_midnight(self, times: Mapping[str, float], told: str) -> tuple[Mapping[str, float], str]:
        """Times by image name, and what is told of them; those of a day go on past midnight."""
        if not is_of_day(self.time_format):
            return times, told
        seconds, passed = unrolled_midnight(list(times.values()))
        told += "; 24 h were added to those after midnight" if passed else ""
        return dict(zip(times, seconds, strict=True)), told


def _looked_up(times: Mapping[str, float], names: Sequence[str], path: Path) -> dict[str, float]:
    """Seconds of those images that the table in ``path`` names, with folders or without.

    Raises:
        SceneError: it has different times for an image.
    """
    found = {}
    for name, rows in same_files(names, times).items():
        if len({times[row] for row in rows}) > 1:
            raise SceneError(
                f"{path}: {' and '.join(rows)} have different times and may both be {name}; keep one of them"
            )
        if rows:
            found[name] = times[rows[0]]
    return found
