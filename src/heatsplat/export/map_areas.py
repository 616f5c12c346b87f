"""Connected areas of a map that an isotherm holds: outlines, sizes and temperatures, as a table and for GIS programs."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from heatsplat.export.formats.base import optional
from heatsplat.export.place import Place
from heatsplat.io.files import write_atomically
from heatsplat.io.tables import write_csv

BY_CORNERS = np.ones((3, 3), dtype=bool)  # pixels that touch at a corner are connected, too
LEAST_PIXELS = 4  # of an area, where nobody says how large it must be: fewer are pixels that noise has lifted


@dataclass(frozen=True)
class Area:
    """A connected area of a map.

    Args:
        polygons: as GeoJSON has them: rings of each in the map's coordinates, the outer one first.
        size: in squares of the map's unit, as seen from above.
        mean, least, most: of its pixels.
        spot: row and column of its hottest pixel, or of its coldest where an isotherm holds all below a value.
    """

    polygons: Sequence[Sequence[Sequence[tuple[float, float]]]]
    size: float
    mean: float
    least: float
    most: float
    spot: tuple[int, int]


def areas_of(values: np.ndarray, isotherm: tuple[float, float], grid: Any, least: float | None = None) -> list[Area]:
    """The areas of a map that an isotherm holds, the hottest first; the coldest first where it holds all below a value.

    Args:
        values: [H, W], NaN where nothing is known, which belongs to no area.
        isotherm: lowest and highest value, of which one may be infinite.
        grid: affine transform from columns and rows to the map's coordinates, north up.
        least: size of the smallest, in squares of the map's unit; None: four pixels.

    Raises:
        ImportError: rasterio is not installed.
    """
    low, high = isotherm
    pixel = abs(grid.a * grid.e)
    labels, count = ndimage.label((values >= low) & (values <= high), BY_CORNERS)
    sizes = pixel * np.bincount(labels.ravel(), minlength=count + 1)
    labels[sizes[labels] < (LEAST_PIXELS * pixel if least is None else least)] = 0
    polygons: dict[int, list] = {}
    shapes = optional("rasterio.features", "map").shapes
    for shape, label in shapes(labels.astype(np.int32), mask=labels > 0, transform=grid):
        polygons.setdefault(int(label), []).append(shape["coordinates"])
    sign = 1.0 if np.isfinite(low) else -1.0
    found = []
    for label, box in enumerate(ndimage.find_objects(labels), start=1):
        if box is None:
            continue
        own = labels[box] == label
        row, column = np.unravel_index(np.where(own, sign * values[box], -np.inf).argmax(), own.shape)
        inside = values[box][own].astype(np.float64)
        spot = box[0].start + int(row), box[1].start + int(column)
        found.append(Area(polygons[label], float(sizes[label]), inside.mean(), inside.min(), inside.max(), spot))
    return sorted(found, key=lambda area: -area.most if sign > 0 else area.least)


def write_areas(
    path: Path, areas: Sequence[Area], grid: Any, place: Place, unit: str, heights: np.ndarray | None = None
) -> list[Path]:
    """Writes the areas of a map beside it; the paths of the files.

    ``<map>_areas.csv`` has a row for each: a number from 1 on, size, temperatures, and where its hottest (coldest) pixel lies.
    ``<map>_areas.geojson`` has the same with the outlines, in degrees of WGS 84 (RFC 7946), where the map has a place on the
    earth.

    Args:
        path: of the map.
        areas: of the map.
        grid: affine transform from columns and rows to the map's coordinates, north up.
        place: of the map.
        unit: of its values, "°C" or "".
        heights: [H, W] of the surface in the map's unit, NaN where it is not known; None leaves them out.

    Raises:
        ImportError: rasterio is not installed.
    """
    of_values, of_size = "_c" if unit == "°C" else "", "m2" if place.unit == "metre" else "square_units"
    rows = []
    for number, area in enumerate(areas, start=1):
        x, y = grid.c + (area.spot[1] + 0.5) * grid.a, grid.f + (area.spot[0] + 0.5) * grid.e
        row = {"number": number, f"area_{of_size}": float(f"{area.size:.6g}")}
        row |= {f"mean{of_values}": area.mean, f"min{of_values}": area.least, f"max{of_values}": area.most}
        row |= {"spot_x": x, "spot_y": y}
        if heights is not None:
            height = float(heights[area.spot])
            row["spot_height"] = height if np.isfinite(height) else None
        rows.append({name: round(value, 3) if isinstance(value, float) else value for name, value in row.items()})
    placed = place.crs is not None
    features = []
    if placed and rows:
        warp = optional("rasterio.warp", "map")
        spots = ([row[name] for row in rows] for name in ("spot_x", "spot_y"))
        for row, east, north in zip(rows, *warp.transform(place.crs, "EPSG:4326", *spots), strict=True):
            row |= {"spot_longitude_deg": round(east, 8), "spot_latitude_deg": round(north, 8)}
        for row, area in zip(rows, areas, strict=True):
            shape = {"type": "MultiPolygon", "coordinates": area.polygons}
            outline = warp.transform_geom(place.crs, "EPSG:4326", shape, precision=8)
            features.append({"type": "Feature", "properties": row, "geometry": outline})
    table = path.with_name(f"{path.stem}_areas.csv")
    write_csv(table, rows, None if rows else ["number"])
    if not placed:
        return [table]
    outlines = path.with_name(f"{path.stem}_areas.geojson")
    write_atomically(outlines, json.dumps({"type": "FeatureCollection", "features": features}))
    return [table, outlines]
