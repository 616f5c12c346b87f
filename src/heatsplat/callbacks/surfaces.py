"""The hottest and coldest surfaces of a scene: a table, and a picture with their numbers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytorch_lightning as pl
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from heatsplat.callbacks.images import scene_bounds
from heatsplat.contracts import Frame, SceneData, SceneError, check_count, evenly_spread
from heatsplat.export.place import Place, placed, unit_in_metres
from heatsplat.geometry.coverage import DEPTH_TOLERANCE
from heatsplat.geometry.extremes import Surface, extremes
from heatsplat.geometry.looks import Look
from heatsplat.geometry.projection import to_camera, to_pixels
from heatsplat.io.pictures import Bar, Panel, colorize, compose, enlarged, lettering, write_png
from heatsplat.io.quantities import moment
from heatsplat.io.tables import write_csv
from heatsplat.shots import SIGHTING_SIZE, at_time, first_free_id, mask_on

SURFACES_FILE = "surfaces.csv"
SURFACES_PICTURE = "renders/surfaces.png"
ENLARGED = 640  # pixels of the longer side of the picture's image, about
MARK = 8  # pixels
NAME = 24  # pixels of a name beside it


class ExtremeSurfaces(pl.Callback):
    """Writes surfaces.csv and renders/surfaces.png at the end of the test, of scenes that have temperatures.

    As the model renders them, without what the camera adds, at the moment of the training image nearest to the middle of the
    record. Areas are those of what training views see, in square metres where the scene's scale is known, by itself or by the
    positions of its cameras (the log names these). The table tells where surfaces lie in the coordinates of the data set, and on
    the earth where the scene's camera positions do (``export.place``).

    Args:
        views: training views from which surfaces are looked for, spread evenly.
        share: of the area that counts as hot, and as cold.
        count: surfaces of each kind.
    """

    def __init__(self, views: int = 12, share: float = 0.03, count: int = 4) -> None:
        check_count("callbacks.surfaces.views", views)
        check_count("callbacks.surfaces.count", count, 0)
        if not 0 < share <= 1:
            raise SceneError(f"callbacks.surfaces.share must lie in (0, 1], got {share}")
        self.views, self.share, self.count = views, share, count

    def on_test_epoch_end(self, trainer: pl.Trainer, module: pl.LightningModule) -> None:
        scene = module.scene
        if scene.range_of(module.modality) is None:
            return
        views = [scene.train[i] for i in evenly_spread(len(scene.train), self.views)]
        frames = [middle(scene, view.frame) for view in views]
        looks = [look(module, frame, mask_on(frame.camera, view)) for frame, view in zip(frames, views, strict=True)]
        hot, cold = extremes(looks, self.share, self.count, reach(scene))
        place = placed(scene) if hot or cold else None
        metres = unit_in_metres(scene, place)
        unit, square = ("m", metres**2) if metres else ("units", 1.0)
        rows = [
            {
                "kind": kind,
                "number": number,
                "mean_c": round(one.mean, 3),
                "most_c": round(one.most, 3),
                "area": float(f"{one.area * square:.3g}"),
                "unit": f"{unit}²" if metres else "square units",
                **{
                    axis: round(value, 4)
                    for axis, value in zip("xyz", (one.centre + scene.origin).tolist(), strict=True)
                },
                "time_s": frames[0].time_s,
            }
            for kind, found in (("hottest", hot), ("coldest", cold))
            for number, one in enumerate(found, start=1)
        ]
        if rows:
            for row, places in zip(rows, on_earth(place, [one.centre for one in (*hot, *cold)]), strict=True):
                row.update(places)
            write_csv(module.output_dir / SURFACES_FILE, rows)
            write_png(module.output_dir / SURFACES_PICTURE, picture(looks, hot, cold, scene, frames[0].time_s))


def reach(scene: SceneData) -> tuple[Tensor, Tensor] | None:
    """Lowest and highest corner [3] of where surfaces may lie: a little beside the points of the reconstruction; None where its
    points are made up."""
    if "points_random" in scene.notes:
        return None
    beside = DEPTH_TOLERANCE * scene.distance
    low, high = scene.box
    return low.double() - beside, high.double() + beside


def on_earth(place: Place | None, points: Sequence[Tensor]) -> list[dict[str, Any]]:
    """Columns for the place of each point [3] on the earth; none where the scene does not lie there."""
    if place is None:
        return [{}] * len(points)
    stacked = torch.stack([*points])
    metres, degrees = place(stacked).tolist(), place.latitudes_longitudes(stacked)
    return [
        {
            "crs": place.crs, "east_m": round(east, 2), "north_m": round(north, 2), "height_m": round(height, 2),
            "latitude_deg": round(latitude, 7), "longitude_deg": round(longitude, 7),
        }
        for (east, north, height), (latitude, longitude) in zip(metres, degrees, strict=True)
    ]  # fmt: skip


def middle(scene: SceneData, frame: Frame) -> Frame:
    """What the camera of a frame sees at the moment of the training image nearest to the middle of the record, where there is
    time, small enough for a look. It is no training image: what the model knows of that one, such as how far its level had
    drifted, is not true of surfaces."""
    if frame.time_s is not None:
        frame = at_time(scene, frame, scene.middle_s)
    return replace(frame, camera=frame.camera.within(SIGHTING_SIZE), frame_id=first_free_id(scene))


@torch.no_grad()
def look(module: pl.LightningModule, frame: Frame, mask: Tensor | None = None) -> Look:
    """What the model shows in a frame, without what its camera adds, °C: from the camera as it is given, not as the run learned
    it, for ``Look`` finds places by that camera's rays. NaN where a mask [H, W] is False: no image told what is there."""
    output = module.render(frame, camera=frame.camera)
    values = module.scene.thermal_range.to_celsius(output.features[..., 0].clamp(0, 1))
    values = values.cpu() if mask is None else values.cpu().where(mask, torch.nan)
    return Look(frame.camera, module.surface(frame), values)


def picture(
    looks: list[Look], hot: list[Surface], cold: list[Surface], scene: SceneData, time_s: float | None
) -> np.ndarray:
    """The one or two views that show the foremost surfaces, with their numbers (``best_two``)."""
    marked = [(f"{kind}{i}", one.centre) for kind, found in (("H", hot), ("C", cold)) for i, one in enumerate(found, 1)]
    shown = [[(name, place) for name, point in marked if (place := _place(one, point)) is not None] for one in looks]
    best, second = best_two([{name for name, _ in one} for one in shown])
    missing = {name for name, _ in marked} - {name for name, _ in shown[best]}
    found = {name for name, _ in shown[second]} & missing
    low, high = scene_bounds(scene, "thermal")
    title = "H hottest, C coldest" + ("" if time_s is None else f" after {moment(time_s)}")
    nowhere = [name for name, _ in marked if name in missing - found]
    title += f"; not in view: {', '.join(nowhere)}" if nowhere else ""
    panels = [Panel(_marked(looks[best], shown[best], low, high), title)]
    if found:
        others = ", ".join(name for name, _ in marked if name in found)
        panels.append(Panel(_marked(looks[second], shown[second], low, high), f"another view, with {others}"))
    panels[-1] = replace(panels[-1], bar=Bar(low, high, "°C"))
    return compose(panels)


def best_two(shown: Sequence[set[str]]) -> tuple[int, int]:
    """The two views, of those that show the surfaces with these names (H1, C1, H2, ...), that together show both first ones
    where any view does, then as many as they can of the second, of the third, and so on.

    Of equals those that show most, hot and cold ones in the first of them; both are the same where there is one view.
    """
    ranks = range(1, 1 + max((int(name[1:]) for names in shown for name in names), default=0))

    def both(names: set[str]) -> tuple[int, int]:
        """How many of the rarer kind, and how many in all."""
        warm = sum(name.startswith("H") for name in names)
        return min(warm, len(names) - warm), len(names)

    def worth(pair: tuple[int, int]) -> tuple:
        one, other = shown[pair[0]], shown[pair[1]]
        seen = one | other
        return [sum(f"{kind}{rank}" in seen for kind in "HC") for rank in ranks], both(one), both(other)

    return max(product(range(len(shown)), repeat=2), key=worth)


def _marked(one: Look, shown: Sequence[tuple[str, tuple[float, float]]], low: float, high: float) -> np.ndarray:
    """The image of a look with names at some of its pixels (column, row)."""
    factor = max(1, round(ENLARGED / max(one.values.shape)))
    page = Image.fromarray(enlarged(colorize(one.values, low, high), factor))
    draw = ImageDraw.Draw(page)
    for name, (column, row) in shown:
        x, y = column * factor, row * factor
        draw.ellipse((x - MARK, y - MARK, x + MARK, y + MARK), outline="white", width=2)
        beside = MARK + 2 if x + MARK + NAME < page.width else -MARK - NAME
        lettering(draw, (x + beside, y), name)
    return np.asarray(page)


def _place(one: Look, point: Tensor) -> tuple[float, float] | None:
    """Column and row of a point of a surface in a look that sees it."""
    local = to_camera(point[None], one.camera.viewmat)
    column, row = to_pixels(local, one.camera.K)[0].tolist()
    if local[0, 2] <= 0 or not (0 <= column < one.camera.width and 0 <= row < one.camera.height):
        return None
    there = one.depth[int(row), int(column)].item()
    return (column, row) if abs(local[0, 2].item() - there) <= 2 * DEPTH_TOLERANCE * there else None
