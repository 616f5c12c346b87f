"""Areas of a map that an isotherm holds: which pixels, how large, and where on the earth."""

import json

import numpy as np
import pytest
import torch

from heatsplat.export.map_areas import areas_of, write_areas
from heatsplat.export.place import Place
from heatsplat.geometry.alignment import Similarity
from heatsplat.io.tables import read_csv

rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed (pip install -e '.[dev]')")

VALUES = np.full((8, 10), 20.0, dtype=np.float32)
VALUES[1:3, 1:4] = 31.0  # 6 pixels
VALUES[2, 3] = 35.5
VALUES[3, 4] = 30.0  # at a corner of it, and on the limit
VALUES[5:8, 6:9] = 40.0  # a ring of 8 around one that is not known
VALUES[6, 7] = np.nan
VALUES[0, 9] = 50.0  # alone
VALUES[7, 0:4] = 5.0  # cold
VALUES[7, 2] = 4.0


def grid(pixel=0.5, west=500_000.0, north=5_700_000.0):
    return rasterio.transform.from_origin(west, north, pixel, pixel)


def place(crs):
    return Place(Similarity(torch.tensor(1.0), torch.eye(3), torch.zeros(3)), crs, "metre")


def test_areas_are_connected_pixels_the_hottest_first():
    ring, block = areas_of(VALUES, (30.0, np.inf), grid())
    assert (ring.size, ring.mean, ring.least, ring.most) == (8 * 0.25, 40.0, 40.0, 40.0)
    assert (block.size, block.least, block.most, block.spot) == (7 * 0.25, 30.0, 35.5, (2, 3))
    assert block.mean == pytest.approx((5 * 31.0 + 35.5 + 30.0) / 7)
    ((outer, hole),) = ring.polygons
    assert set(outer) == {(500_000 + x, 5_700_000 - y) for x in (3.0, 4.5) for y in (2.5, 4.0)}
    assert set(hole) == {(500_000 + x, 5_700_000 - y) for x in (3.5, 4.0) for y in (3.0, 3.5)}
    assert len(block.polygons) == 2  # which touch at a corner, where a polygon may not


@pytest.mark.parametrize(
    ("isotherm", "least", "found"),
    [
        ((30.0, np.inf), 0.25, [50.0, 40.0, 35.5]),
        ((30.0, np.inf), 1.9, [40.0]),
        ((30.0, 36.0), None, [35.5]),
        ((60.0, np.inf), None, []),
    ],
)
def test_small_areas_are_left_out(isotherm, least, found):
    assert [area.most for area in areas_of(VALUES, isotherm, grid(), least)] == found


def test_below_a_value_the_coldest_pixel_counts():
    (area,) = areas_of(VALUES, (-np.inf, 10.0), grid())
    assert (area.spot, area.least, area.size) == ((7, 2), 4.0, 1.0)


def test_a_table_and_outlines_in_degrees_lie_beside_the_map(tmp_path):
    heights = np.full(VALUES.shape, 12.5)
    heights[6, 8] = np.nan
    areas = areas_of(VALUES, (30.0, np.inf), grid())
    table, outlines = write_areas(tmp_path / "roof.tif", areas, grid(), place("EPSG:32631"), "°C", heights)
    assert (table.name, outlines.name) == ("roof_areas.csv", "roof_areas.geojson")
    first, second = read_csv(table)
    assert (first["number"], first["area_m2"], first["max_c"]) == (1, 2.0, 40.0)
    assert (second["spot_x"], second["spot_y"]) == (500_001.75, 5_699_998.75)
    assert second["spot_height"] == 12.5
    # UTM counts eastings from 500 km at the central meridian of zone 31, 3 degrees; scale there 0.9996.
    assert second["spot_longitude_deg"] == pytest.approx(
        3.0 + 1.75 / 0.9996 / (6388000 * np.cos(np.radians(51.45))) * 57.29578, abs=2e-7
    )
    written = json.loads(outlines.read_text())
    assert [one["properties"]["number"] for one in written["features"]] == [1, 2]
    back = rasterio.warp.transform_geom("EPSG:4326", "EPSG:32631", written["features"][0]["geometry"])
    corners = np.array(back["coordinates"][0][0])
    np.testing.assert_allclose(corners.min(0), [500_003.0, 5_699_996.0], atol=2e-3)
    np.testing.assert_allclose(corners.max(0), [500_004.5, 5_699_997.5], atol=2e-3)


def test_a_map_without_a_place_has_a_table_alone(tmp_path):
    (table,) = write_areas(tmp_path / "a.tif", areas_of(VALUES, (30.0, np.inf), grid()), grid(), place(None), "")
    assert set(read_csv(table)[0]) == {"number", "area_m2", "mean", "min", "max", "spot_x", "spot_y"}


def test_of_no_areas_there_is_a_table_without_rows(tmp_path):
    table, outlines = write_areas(tmp_path / "a.tif", [], grid(), place("EPSG:32631"), "°C")
    assert read_csv(table) == [] and json.loads(outlines.read_text())["features"] == []
