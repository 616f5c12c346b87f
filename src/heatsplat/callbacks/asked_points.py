"""Points of which a user asks for curves, as a table names them."""

from __future__ import annotations

import csv
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, number_in, table_lines, text_in
from heatsplat.geometry.projection import to_world

OPTION = "callbacks.probes.points"
PLACE, PIXEL = ("x", "y", "z"), ("view", "row", "column")
FARTHEST = 1e12  # beyond lie no coordinates


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

    def placed(self, depth_of: Callable[[Frame], Tensor], camera_of: Callable[[Frame], Camera]) -> Tensor | None:
        """[3] float64: where the table has no place, on the surface that ``depth_of`` [H, W] (camera z, infinite without one)
        knows of the frame, from where ``camera_of`` has its camera stand; None where that pixel shows none."""
        if self.point is not None:
            return self.point
        camera = camera_of(self.frame)
        depth = float(depth_of(self.frame)[self.row, self.column])
        if not depth < float("inf"):
            return None
        at = torch.tensor([self.column + 0.5, self.row + 0.5, 1.0], dtype=torch.float64)
        return to_world(depth * torch.linalg.solve(camera.K, at), camera.viewmat)


def asked_points(path: Path | str, scene: SceneData) -> list[AskedPoint]:
    """The points of a table.

    Args:
        path: CSV with the columns x, y, z in the coordinates of the data set, or view, row, column of a pixel of a frame (its
            name, and whole numbers from 0 at the top left); name may be left out. What probe_positions.csv has will do, and
            columns apart by semicolon or tab, with decimal commas.
        scene: whose points they are.

    Raises:
        SceneError: there is no such table, it has other columns, or a row that is no point; file and row are named.
    """
    rows = _rows(path)
    if not rows:
        raise SceneError(f"{OPTION}={path} has no point: a line of column names and one line for each point are needed")
    columns = next((needed for needed in (PLACE, PIXEL) if set(needed) <= rows[0].keys()), None)
    if columns is None:
        raise SceneError(
            f"{OPTION}={path} has the columns {', '.join(rows[0])}; {', '.join(PLACE)} or {', '.join(PIXEL)} are needed"
        )
    frames = {frame.name: frame for frame in scene.frames}
    found = []
    for number, row in enumerate(rows, 1):
        where, name = f"{OPTION}={path}, row {number}", row.get("name") or f"point {number}"
        if columns == PLACE:
            place = torch.tensor([_number(row, key, where) for key in PLACE], dtype=torch.float64)
            found.append(AskedPoint(name, place - scene.origin))
            continue
        frame = frames.get(row["view"])
        if frame is None:
            raise SceneError(
                f"{where}: '{row['view']}' is no frame of scene '{scene.name}'; names look like {next(iter(frames))}"
            )
        at_row, at_column = (int(_number(row, key, where)) for key in PIXEL[1:])
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


def _rows(path: Path | str) -> list[dict[str, str]]:
    """The rows of a table by column, as text. Raises SceneError where it cannot be read."""
    try:
        text = text_in(Path(path).expanduser().read_bytes())
        lines = [line for _, line in table_lines(text, comments=False)]  # a point may be called #1
        apart = max(",;\t", key=(lines or [""])[0].count)
        head, *rows = [[cell.strip() for cell in row] for row in csv.reader(lines, delimiter=apart)] or [[]]
    except (OSError, ValueError, csv.Error) as error:
        raise SceneError(f"{OPTION}={path} cannot be read: {error}") from error
    if wrong := next((number for number, row in enumerate(rows, 1) if len(row) != len(head)), None):
        raise SceneError(f"{OPTION}={path}, row {wrong}: {len(rows[wrong - 1])} cells for {len(head)} columns")
    return [dict(zip(head, row, strict=True)) for row in rows]


def _number(row: dict[str, str], key: str, where: str) -> float:
    try:
        number = number_in(row[key].replace(",", "."))
    except ValueError:
        number = float("nan")
    if not abs(number) < FARTHEST:
        raise SceneError(f"{where}: {key} is '{row[key]}', a number is needed")
    return number
