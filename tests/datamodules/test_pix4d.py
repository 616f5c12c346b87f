"""Pix4D's calibrated camera parameters: known cameras written as it writes them and read back, its equations, damaged files."""

import cv2
import numpy as np
import pytest
from aligned import UTM, east_north_up_at, geocentric, seen_by_pix4d, write_pix4d

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.pix4d import read_pix4d
from heatsplat.datamodules.synthetic_scene.paths import camera_path

VIEWMATS = {f"DJI {i}.JPG": v for i, v in enumerate(camera_path(np.linspace(20.0, 600.0, 5), 600.0, 0).numpy())}
OFFSET = (
    702345.0,
    5678901.0,
    87.0,
)  # far from the zone's meridian: its north is turned by 2.3 degrees against true north


@pytest.mark.parametrize(
    ("offset", "projection", "metres", "says"),
    [
        (None, UTM, 1.0, "no flight_offset.xyz beside it"),
        (OFFSET, "", None, "no flight_wkt.prj beside it"),
        (
            OFFSET,
            UTM.replace("UTM zone 32N", "Gauss-Kruger zone 3"),
            1.0,
            "flight_wkt.prj is not UTM of WGS 84, in metres",
        ),
        (OFFSET, UTM.replace('"metre",1]', '"foot",0.3048]'), 0.3048, "is not UTM of WGS 84, in metres"),
    ],
)
def test_cameras_without_a_known_projection_come_back_as_they_are(tmp_path, offset, projection, metres, says):
    found = read_pix4d(write_pix4d(tmp_path, VIEWMATS, offset, projection))
    assert list(found.cameras) == list(VIEWMATS)
    np.testing.assert_allclose([v for v, _ in found.cameras.values()], list(VIEWMATS.values()), atol=1e-6)
    assert (found.metres_per_unit, found.origin, found.east_north_up) == (metres, None, False)
    assert says in found.notes[-1]


def test_points_are_seen_where_pix4d_s_equations_put_them(tmp_path):
    lens = read_pix4d(write_pix4d(tmp_path, VIEWMATS)).cameras["DJI 0.JPG"][1]
    points = np.random.default_rng(0).uniform([-2.0, -1.6, 4.0], [2.0, 1.6, 5.0], (200, 3))
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix(), np.array(lens.distortion))[0][:, 0]
    assert np.abs(seen - seen_by_pix4d(points)).max() < 1e-6
    assert (lens.width, lens.height, lens.cx, lens.cy) == (40, 32, 21.25, 15.25)


def test_in_a_utm_zone_places_on_the_earth_are_seen_where_the_file_s_own_coordinates_put_them(tmp_path):
    warp = pytest.importorskip("rasterio.warp", reason="rasterio is not installed (pip install -e '.[dev]')")
    found = read_pix4d(write_pix4d(tmp_path, VIEWMATS, OFFSET, UTM))
    assert found.east_north_up and found.metres_per_unit == 1.0 and "UTM zone 32N" in found.notes[-1]
    # Points below the cameras, in the file's coordinates, and in metres east, north and up by another library.
    grid = np.random.default_rng(0).uniform([-30.0, -30.0, -40.0], [30.0, 30.0, -20.0], (20, 3))

    def lies(coordinates):
        east, north, up = (np.asarray(coordinates) + OFFSET).T
        longitude, latitude = warp.transform("EPSG:32632", "EPSG:4326", east, north)
        return np.column_stack([latitude, longitude, up])

    first = lies([np.linalg.inv(VIEWMATS["DJI 0.JPG"])[:3, 3]])[0]
    np.testing.assert_allclose(found.origin, first, atol=1e-8)
    world = np.stack([geocentric(place) for place in lies(grid)]) - geocentric(first)
    world = world @ east_north_up_at(first).T

    def seen(points, viewmat):  # directions in the axes of a camera
        before = points @ viewmat[:3, :3].T + viewmat[:3, 3]
        return before / np.linalg.norm(before, axis=1, keepdims=True)

    for name, viewmat in VIEWMATS.items():
        turned = found.cameras[name][0]
        assert np.abs(seen(grid, viewmat) - seen(world, turned)).max() < 3e-4  # heights are not stretched with the map
        assert np.abs(seen(grid, viewmat) - seen(grid, turned)).max() > 0.01  # the turn of 2.3 degrees matters


@pytest.mark.parametrize(
    ("before", "after", "says"),
    [
        (
            "DJI 0.JPG 40 32\n",
            "",
            "flight_.*txt, line 9: fileName imageWidth imageHeight are needed, it is '38.0 0 21.25'",
        ),
        (
            "0 0 1\n-0.21",
            "0 1\n-0.21",
            "txt, line 12: camera matrix K of DJI 0.JPG: 3 numbers are needed, it has 2; process",
        ),
        (
            "-0.21 ",
            "-0,21 ",
            "txt, line 13: radial distortion of DJI 0.JPG: could not convert string to float: '-0,21'; process",
        ),
        ("0.004 -0.002", "0.004", "txt, line 14: tangential distortion of DJI 0.JPG: 2 numbers are needed, it has 1"),
        ("\nDJI", "\n", "flight_.*txt, line 9: camera rotation R of .* is no pose"),
    ],
)
def test_damaged_files_are_refused_with_the_line_the_key_and_a_remedy(tmp_path, before, after, says):
    path = write_pix4d(tmp_path, VIEWMATS)
    text = path.read_text()
    assert before in text
    if before == "\nDJI":  # a mirrored rotation
        lines = text.splitlines()
        lines[15] = " ".join(str(-float(word)) for word in lines[15].split())
        text = "\n".join(lines)
    else:
        text = text.replace(before, after, 1)
    path.write_text(text)
    with pytest.raises(SceneError, match=says):
        read_pix4d(path)


def test_files_that_end_early_or_have_no_image_are_refused(tmp_path):
    path = write_pix4d(tmp_path, VIEWMATS)
    lines = path.read_text().splitlines()
    path.write_text("\n".join(lines[:-4]))
    with pytest.raises(SceneError, match=r"flight_.*txt ends within DJI 4.JPG, after 5 of its 9 lines; process"):
        read_pix4d(path)
    path.write_text("\n".join(lines[:8]))
    with pytest.raises(SceneError, match="has no line of an image .fileName imageWidth imageHeight.; process"):
        read_pix4d(path)
    path = write_pix4d(tmp_path, VIEWMATS)
    path.write_text(path.read_text().replace("DJI 1.JPG", "DJI 0.JPG"))  # of two flights
    found = read_pix4d(path)
    assert list(found.cameras) == [f"DJI {i}.JPG" for i in (2, 3, 4)]
    assert "line 20: DJI 0.JPG has two cameras; take one out" in found.refused["DJI 0.JPG"]
    assert "a skew that moves" in read_pix4d(write_pix4d(tmp_path, VIEWMATS, skew=3.0)).refused["DJI 0.JPG"]
    assert "impossible" in read_pix4d(write_pix4d(tmp_path, VIEWMATS, cx=9e9)).refused["DJI 0.JPG"]
