"""Points of which a user asks for curves, as a table names them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from heatsplat.contracts import Frame, SceneData, SceneError
from heatsplat.io.tables import read_csv

OPTION = "callbacks.probes.points"
PLACE, PIXEL = ("x", "y", "z"), ("view", "row", "column")


@dataclass(frozen=True)
class AskedPoint:
    """A row of the table.

    Args:
        name: of the curve; of several points each another.
        point: [3] in the world of the scene; None where the table says in which pixel it lies.
        frame, row, column: the image in which it lies there, and its pixel.
    """

    name: str
    point: Tensor | None = None
    frame: Frame | None = None
    row: int = 0
    column: int = 0

    def placed(self, depth_of: Callable[[Frame], Tensor]) -> Tensor | None:
        """[3] float64: where the table has no place, on the surface that ``depth_of`` [H, W] (camera z, infinite without one)
        knows of the frame; None where that pixel shows none."""
        if self.point is not None:
            return self.point
        camera = self.frame.camera
        depth = float(depth_of(self.frame)[self.row, self.column])
        if not depth < float("inf"):
            return None
        at = torch.tensor([self.column + 0.5, self.row + 0.5, 1.0], dtype=torch.float64)
        local = depth * torch.linalg.solve(camera.K, at)
        return (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]


def asked_points(path: Path | str, scene: SceneData) -> list[AskedPoint]:
    """The points of a table.

    Args:
        path: CSV with the columns x, y, z in the coordinates of the data set, or view, row, column of a pixel of a frame (its
            name, and whole numbers from 0 at the top left); name may be left out. What probe_positions.csv has will do.
        scene: whose points they are.

    Raises:
        SceneError: there is no such table, it has other columns, or a row that is no point; file and row are named.
    """
    try:
        rows = read_csv(Path(path).expanduser())
    except (OSError, ValueError) as error:
        raise SceneError(f"{OPTION}={path} cannot be read: {error}") from error
    if not rows:
        raise SceneError(f"{OPTION}={path} has no point: a line of column names and one line for each point are needed")
    columns = next((needed for needed in (PLACE, PIXEL) if set(needed) <= rows[0].keys()), None)
    if columns is None:
        raise SceneError(
            f"{OPTION}={path} has the columns {', '.join(map(str, rows[0]))}; {', '.join(PLACE)} or {', '.join(PIXEL)} are needed"
        )
    frames = {frame.name: frame for frame in scene.frames}
    found = []
    for number, row in enumerate(rows, 1):
        where, name = f"{OPTION}={path}, row {number}", _text(row.get("name")) or f"point {number}"
        if columns == PLACE:
            place = torch.tensor(_numbers(row, PLACE, where), dtype=torch.float64)
            found.append(AskedPoint(name, place - scene.origin))
            continue
        frame = frames.get(_text(row["view"]))
        if frame is None:
            raise SceneError(
                f"{where}: '{row['view']}' is no frame of scene '{scene.name}'; names look like {next(iter(frames))}"
            )
        at_row, at_column = (int(value) for value in _numbers(row, PIXEL[1:], where))
        if not (0 <= at_row < frame.camera.height and 0 <= at_column < frame.camera.width):
            raise SceneError(
                f"{where}: row {at_row}, column {at_column} lies outside of {frame.name}, which has {frame.camera.height} rows "
                f"and {frame.camera.width} columns as it is trained on"
            )
        found.append(AskedPoint(name, frame=frame, row=at_row, column=at_column))
    names = [one.name for one in found]
    if twice := next((name for name in names if names.count(name) > 1), None):
        raise SceneError(f"{OPTION}={path} has two points called '{twice}': give each a name of its own")
    return found


def _text(cell: float | str | None) -> str:
    """What a cell says, where that is a name: one of digits alone was read as a number."""
    return "" if cell is None else cell if isinstance(cell, str) else f"{cell:.12g}"


def _numbers(row: dict[str, float | str | None], keys: Sequence[str], where: str) -> list[float]:
    values = [row[key] for key in keys]
    wrong = [k for k, value in enumerate(values) if not isinstance(value, float) or not abs(value) < 1e12]
    if wrong:
        raise SceneError(f"{where}: {keys[wrong[0]]} is {values[wrong[0]]!r}, a number is needed")
    return values
