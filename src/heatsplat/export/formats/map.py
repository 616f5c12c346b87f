"""Orthographic map as GeoTIFF: temperature from above, and what the model learned."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, check_numbers, quantile
from heatsplat.export.formats.base import Format, extra_columns, optional
from heatsplat.export.map_areas import Area, areas_of, write_areas
from heatsplat.export.moment import Moment
from heatsplat.export.place import AUTO, Place, place_in_file
from heatsplat.export.seams import comparison, mosaic, shift_between, smoothed
from heatsplat.geometry.closest_depth import closest_depth
from heatsplat.geometry.coverage import OPEN, covered, gap_free, seen_means
from heatsplat.geometry.looks import surface_points
from heatsplat.geometry.projection import view_matrix
from heatsplat.io.pictures import (
    IMAGE_VALUES,
    MARKED,
    Bar,
    Panel,
    bounds_of,
    checked_isotherm,
    colorize,
    compose,
    enlarged,
    lettering,
    write_png,
)
from heatsplat.io.quantities import moment as said
from heatsplat.shots import at_time, checked_unseen, deviations_told, first_free_id, sightings
from heatsplat.uncertainty import Uncertainty

log = logging.getLogger("heatsplat")

AWAY = 1000.0  # half widths of the map from which it is seen: what stands h high is displaced by h / 1000 at its edge
LARGEST = 8192  # pixels of a side
DEVIATION = "standard deviation"  # band of it
HEIGHT = "height"  # band of it
WIDE = 10  # pixels that a flat scene may be high
NUMBERED = 30  # areas in a picture
SHOWN = 1600  # pixels of the longer side of a picture at most
MARGIN_PX = 12  # of its scale
MARGIN = 0.02  # of the longer side, around the scene's points


class Map(Format):
    """A map seen from straight above, through the splat renderer with a camera of long focal length far away.

    Bands, float32, NaN where there is no surface or no training view saw it: temperature and each
    attribute, as means over what a pixel shows.

    Args:
        resolution: width of a pixel in metres (units of the scene where it has no scale); None takes that of the training
            images.
        bounds: [west, south, east, north] in the map's coordinates; None takes the box of 99 % of the scene's points.
        gps: table of camera positions, "auto" or None (``export.place``); without one the map has no CRS.
        above: [x, y, z] direction in the world from which the map is seen; None finds it (``export.place``).
        unseen: "nan", or "keep" for what the model makes of places that no training view saw.
        uncertainty: the second band is the standard deviation of each pixel's temperature (``heatsplat.uncertainty``), and
            the last ones are those of the attributes.
        height: the last band is the height of the surface in the map's unit, where opacity lies closest along the line from
            above (``geometry.closest_depth``): a digital surface model. It is that of the scene, which GPS may place.
        isotherm: [low, high], or with None for one of them: connected areas that it holds become a table and outlines
            (``export.map_areas``), which the picture has, too. None finds none.
        least_area: of such an area, in squares of the map's unit; None takes four pixels.
        against: such a map, of another run on the same scene or of another survey of the same place: the picture beside the file
            (.png) then compares this map with it and with a mosaic of the recorded images, seams and all (``export.seams``). None
            draws this map alone.
    """

    suffix = ".tif"
    from_origin = False
    of_gaussians = False

    def __init__(
        self,
        resolution: float | None = None,
        bounds: Sequence[float] | None = None,
        gps: str | None = AUTO,
        above: Sequence[float] | None = None,
        unseen: str = "nan",
        uncertainty: bool = False,
        height: bool = False,
        isotherm: Sequence[float | None] | None = None,
        least_area: float | None = None,
        against: str | None = None,
    ) -> None:
        if resolution is not None:
            check_numbers("what.resolution", resolution, error=SceneError, above=0)
        for name, value, count in (("bounds", bounds, 4), ("above", above, 3)):
            if value is not None:
                check_numbers(f"what.{name}", value, count, SceneError)
        if bounds is not None and not (bounds[0] < bounds[2] and bounds[1] < bounds[3]):
            raise SceneError(f"what.bounds must be [west, south, east, north], got {list(bounds)}")
        if above is not None and (not any(above) or gps not in (None, AUTO)):
            raise SceneError(f"what.above must be a direction [x, y, z], and not beside what.gps; got {list(above)}")
        self.isotherm = checked_isotherm("what.isotherm", isotherm)
        if least_area is not None:
            check_numbers("what.least_area", least_area, error=SceneError, above=0)
            if isotherm is None:
                raise SceneError(
                    "what.least_area is of the areas of an isotherm: give what.isotherm, such as [30,null]"
                )
        self.resolution, self.bounds, self.gps = resolution, bounds, gps
        self.uncertainty, self.height, self.least_area = uncertainty, height, least_area
        self.unseen = checked_unseen("what.unseen", unseen)
        self.against = None if against is None else Path(against).expanduser()
        self.above = None if above is None else torch.tensor(above, dtype=torch.float64)

    def write(self, moment: Moment, path: Path) -> None:
        rasterio = optional("rasterio", "map")
        from_origin = optional("rasterio.transform", "map").from_origin
        scene = moment.module.scene
        place = place_in_file(scene, self.gps, self.above)
        west, north, pixel, width, height = self._grid(scene, place)
        grid = from_origin(west, north, pixel, pixel)
        other = None if self.against is None else self._other(rasterio, grid, width, height)
        camera = _from_above(scene, place, west, north, pixel, width, height)
        seen = moment.seen
        shapes = seen.means, seen.quats, seen.scales, seen.opacities[None]
        depth, spread = closest_depth(partial(moment.module.renderer.depths_at_shares, shapes), camera)
        bands = self._bands(moment, camera, depth)
        title, own = next(iter(bands.items()))
        if other is not None and other.title not in (None, title):
            raise SceneError(
                f"what.against={self.against} is a map of {other.title}, this one of {title}: give maps of two runs on "
                "temperatures, or of two on greys"
            )
        if self.height:
            heights = self._heights(scene, place, camera, pixel, depth, spread)
            bands[f"{HEIGHT} [{place.unit}]"] = np.where(np.isfinite(own), heights, np.nan)
        areas = [] if self.isotherm is None else areas_of(own, self.isotherm, grid, self.least_area)
        log.info("map of %d x %d pixels of %.3g %s", width, height, pixel, place.unit)
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            width=width,
            height=height,
            count=len(bands),
            dtype="float32",
            crs=place.crs,
            transform=grid,
            nodata=float("nan"),
            compress="deflate",
            predictor=3,
        ) as file:
            for number, (name, band) in enumerate(bands.items(), start=1):
                file.write(band.astype(np.float32), number)
                file.set_band_description(number, name)
                if name.startswith(DEVIATION):
                    file.update_tags(number, of=deviations_told(scene))
                    log.info("band %d, %s: %s", number, name, deviations_told(scene))
            file.update_tags(
                layer=moment.layer.name,
                lengths=place.unit,
                time_s=str(moment.time_s),
                method=_method(moment),
                scene=scene.name,
            )
        if self.isotherm is not None:
            heights = bands.get(f"{HEIGHT} [{place.unit}]")
            files = write_areas(path, areas, grid, place, moment.seen.unit, heights)
            log.info("%s: %d %s", files[-1], len(areas), "area" if len(areas) == 1 else "areas")
        if other is None:
            picture = _picture(own, moment, place, pixel, areas, grid)
        else:
            _say_shift(other, own, pixel, place.unit, moment.seen.unit, self.against)
            recorded, owner = mosaic(scene, surface_points(camera, smoothed(depth)))
            picture = _compared(moment, bands, other, recorded, owner)
        write_png(path.with_suffix(".png"), picture)

    def _other(self, rasterio: Any, grid: Any, width: int, height: int) -> _Other:
        """The map to compare with. Raises SceneError where it cannot be read or its pixels are not those of this one."""
        other = _read_other(rasterio, self.against)
        if other.values.shape == (height, width) and grid.almost_equals(other.grid, 1e-3 * grid.a):
            return other
        raise SceneError(
            f"what.against={self.against} has {_described(other.grid, *other.values.shape)}, this map "
            f"{_described(grid, height, width)}: write both with the same what.resolution and what.bounds"
        )

    def _grid(self, scene: SceneData, place: Place) -> tuple[float, float, float, int, int]:
        """West and north edge, width of a pixel, columns and rows.

        Raises:
            SceneError: the bounds lie beside the scene, or there are too many pixels.
        """
        points = place(scene.points)[:, :2]
        pixel = self.resolution
        if pixel is None:
            middle = scene.bulk[0].double()
            cameras = [frame.camera for frame in scene.train.frames]
            pixel = place.scale * float(np.median([(c.center - middle).norm() / c.K[0, 0] for c in cameras]))
            pixel = float(f"{pixel:.2g}")
        if self.bounds is None:
            low, high = (quantile(points, share) for share in (0.005, 0.995))
            around = MARGIN * float((high - low).max())
            west, south, east, north = *(low - around).tolist(), *(high + around).tolist()
        else:
            west, south, east, north = map(float, self.bounds)
            (left, bottom), (right, top) = points.amin(0).tolist(), points.amax(0).tolist()
            if west > right or east < left or south > top or north < bottom or min(east - west, north - south) < pixel:
                raise SceneError(
                    f"what.bounds={list(self.bounds)} holds no pixel of the scene, which runs from {left:.1f} to {right:.1f} in "
                    f"x (west, east) and from {bottom:.1f} to {top:.1f} in y (south, north), "
                    + (f"in metres of {place.crs}, not in degrees" if place.crs else f"in the map's {place.unit}")
                )
        width, height = (max(1, round((end - start) / pixel)) for start, end in ((west, east), (south, north)))
        if max(width, height) > LARGEST:
            raise SceneError(
                f"the map would have {width} x {height} pixels of {pixel:g} {place.unit}, more than {LARGEST}: give a coarser "
                "what.resolution, or smaller what.bounds"
            )
        return west, north, pixel, width, height

    @staticmethod
    def _heights(
        scene: SceneData, place: Place, camera: Camera, pixel: float, depth: Tensor, spread: Tensor
    ) -> np.ndarray:
        """Height of the surface [H, W] in the map's unit; NaN where there is none, or opacity is spread over more height than the
        scene's points have."""
        levels = place(scene.points)[:, 2]
        low, high = (quantile(levels, share).item() for share in (0.005, 0.995))
        beyond = high - low + WIDE * pixel  # as far as things stand out of it, or it is flat
        top = float(place(camera.center[None])[0, 2])
        clear = spread * place.scale < beyond  # else it is fog
        heights = (top - place.scale * depth.double()).where(clear, torch.nan)
        return heights.where((heights > low - beyond) & (heights < high + beyond), torch.nan).numpy()

    def _bands(self, moment: Moment, camera: Camera, depth: Tensor) -> dict[str, np.ndarray]:
        """The bands by name, of the map's camera and the depth of the surface [H, W] in it."""
        seen, module = moment.seen, moment.module
        told = extra_columns(moment)
        columns = torch.stack([moment.blended, *told.values()], dim=1)
        values = gap_free(columns)
        with torch.no_grad():
            shapes = seen.means, seen.quats, seen.scales, seen.opacities[None]
            output = module.renderer.values_seen(shapes, values, camera)
        means = seen_means(output.features, output.alpha[0], columns.shape[1])
        means = means.where(output.alpha[0, ..., None] >= OPEN, torch.nan)
        if self.unseen == "nan":
            known = covered(camera, depth, sightings(module.scene, module.surface)).to(means.device)
            means = means.where(known[..., None], torch.nan)
        unit = seen.unit.replace("°", "deg ")
        unit = f" [{unit}]" if unit else ""
        bands = {f"{moment.quantity}{unit}": moment.of_blended(means[..., 0]).numpy()}
        maps = dict(zip(told, means[..., 1:].unbind(-1), strict=True))
        maps |= module.thermal.quotients(maps)
        intervals: dict[str, np.ndarray] = {}
        if self.uncertainty:
            frame = at_time(module.scene, Frame("map", first_free_id(module.scene), camera), moment.time_s)
            certainty = Uncertainty(module)
            deviation = certainty.deviation(frame)
            bands[f"{DEVIATION}{unit}"] = deviation.where(means[..., 0].isfinite().cpu(), torch.nan).numpy()
            for name, spread in certainty.attribute_deviations(frame).items():
                intervals[f"{name} {DEVIATION}"] = spread.where(maps[name].isfinite().cpu(), torch.nan).numpy()
        return bands | {name: values.numpy() for name, values in maps.items()} | intervals


def _method(moment: Moment) -> str:
    return str(moment.module.config.get("name") or type(moment.module.thermal).__name__)


@dataclass(frozen=True)
class _Other:
    """A map that was written before: its method and scene, first band [H, W], and how pixels become coordinates."""

    method: str
    scene: str
    values: np.ndarray
    grid: Any
    title: str | None  # what the band holds, where heatsplat wrote it


def _read_other(rasterio: Any, path: Path) -> _Other:
    """A map that was written before. Raises SceneError where it cannot be read."""
    try:
        with rasterio.open(path) as file:
            tags = file.tags()
            title = file.descriptions[0] if "layer" in tags else None
            return _Other(
                tags.get("method", path.stem), tags.get("scene", path.stem), file.read(1), file.transform, title
            )
    except rasterio.errors.RasterioIOError as error:
        raise SceneError(f"what.against={path} cannot be read: {error}") from error


def _described(grid: Any, height: int, width: int) -> str:
    return f"{width} x {height} pixels of {grid.a:g} from ({grid.c:.10g}, {grid.f:.10g}) on"


def _say_shift(other: _Other, own: np.ndarray, pixel: float, unit: str, values: str, path: Path | None) -> None:
    """Logs how far another map lies from this one and by how much it is warmer; warns where that is more than a pixel."""
    rows, columns, there, here = shift_between(other.values, own)
    apart = other.values - own
    level = float(np.nanmedian(apart)) if np.isfinite(apart).any() else float("nan")
    moved = max(abs(rows), abs(columns)) > 1
    (log.warning if moved else log.info)(
        "what.against=%s lies %.3g %s to the east and %.3g to the north of this map, by how they correlate (%.3f there, %.3f as "
        "they lie)%s",
        path, columns * pixel, unit, -rows * pixel, there, here, "; a difference of the two shows that shift" * moved,
    )  # fmt: skip
    log.info("what.against is %.2f %s warmer than this map in the median, which their difference holds", level, values)


def _compared(
    moment: Moment, bands: Mapping[str, np.ndarray], other: _Other, recorded: np.ndarray, owner: np.ndarray
) -> np.ndarray:
    """The picture of a map beside the images and another map."""
    scene = moment.module.scene
    before, now = other.method, _method(moment)
    if other.scene != scene.name:
        before, now = f"{before}, {other.scene}", f"{now}, {scene.name}"
    names = ("images", before, now if now != before else f"{now}, this run")
    maps = dict(zip(names, (recorded, other.values, next(iter(bands.values()))), strict=True))
    spread = next((band for title, band in bands.items() if title.startswith(DEVIATION)), None)
    return comparison(maps, owner, moment.seen.unit or IMAGE_VALUES, spread)


def _picture(
    values: np.ndarray, moment: Moment, place: Place, pixel: float, areas: Sequence[Area], grid: Any
) -> np.ndarray:
    """A map in colours, with a bar of them, a scale of lengths, and the outlines of areas; the first of them with numbers.

    ``grid`` is the affine transform from columns and rows to the map's coordinates, north up.
    """
    known = values[np.isfinite(values)]
    low, high = bounds_of(known) if len(known) else moment.seen.limits
    step = -(-max(values.shape) // SHOWN)
    image = colorize(values[::step, ::step], low, high)
    factor = max(1, SHOWN // (2 * max(image.shape)))
    page = Image.fromarray(enlarged(image, factor))
    a_pixel = pixel * step / factor
    length = 10.0 ** np.floor(np.log10(0.5 * page.width * a_pixel))
    end = MARGIN_PX + length / a_pixel
    draw = ImageDraw.Draw(page)
    for colour, wide in (("black", 6), ("white", 2)):
        draw.line((MARGIN_PX, page.height - MARGIN_PX, end, page.height - MARGIN_PX), fill=colour, width=wide)
    shrunk = factor / step
    for number, area in enumerate(areas, start=1):
        for ring in (ring for polygon in area.polygons for ring in polygon):
            corners = [(shrunk * (x - grid.c) / grid.a, shrunk * (y - grid.f) / grid.e) for x, y in ring]
            draw.line(corners, fill=MARKED, width=max(1, factor // 2))
        if number <= NUMBERED:
            row, column = area.spot
            lettering(draw, (shrunk * column + 4, shrunk * row), str(number))
    lettering(
        draw, (end + MARGIN_PX, page.height - MARGIN_PX), f"{length:g} {'m' if place.unit == 'metre' else 'units'}"
    )
    title = moment.module.scene.name + ("" if moment.time_s is None else f" after {said(moment.time_s)}")
    title += f", north up, {place.crs}" if place.crs else ""
    return compose([Panel(np.asarray(page), title, Bar(low, high, moment.seen.unit or IMAGE_VALUES))])


def _from_above(
    scene: SceneData, place: Place, west: float, north: float, pixel: float, width: int, height: int
) -> Camera:
    """A camera straight above the middle of the map whose pixels, at the height of the scene's points, are the map's."""
    ground = float(place(scene.points)[:, 2].median())
    away = AWAY * 0.5 * pixel * max(width, height)
    eye = torch.tensor([west + 0.5 * pixel * width, north - 0.5 * pixel * height, ground + away], dtype=torch.float64)
    scale, rotation, shift = place.similarity
    turned = torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)) @ rotation  # x east, y south, z down
    viewmat = view_matrix(turned, rotation.T @ (eye - shift) / scale)
    focal = away / pixel
    K = torch.tensor([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]], dtype=torch.float64)
    return Camera(viewmat, K, width, height)
