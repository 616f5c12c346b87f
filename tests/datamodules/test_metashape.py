"""Metashape's cameras.xml: known cameras written as it writes them and read back, its equations of the lens, damaged files."""

import re

import cv2
import numpy as np
import pytest
import torch
from aligned import (
    LOCAL,
    METASHAPE,
    WGS_84,
    calibration,
    camera,
    east_north_up_at,
    geocentric,
    in_chunk,
    seen_by_metashape,
    transform_of,
    write_metashape,
)

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.lens import undistortion_maps
from heatsplat.datamodules.formats.metashape import read_metashape
from heatsplat.datamodules.synthetic_scene.paths import camera_path
from heatsplat.geometry.rotations import quats_to_matrices

VIEWMATS = camera_path(np.linspace(20.0, 600.0, 6), 600.0, 0).numpy()  # of a synthetic scene
TURN = quats_to_matrices(torch.tensor([0.3, -0.5, 0.7, 0.4], dtype=torch.float64)).numpy()
PLACE = np.array([51.2345678, 7.3456789, 123.4])
K4 = {"f": 74.1, "cx": 0.23, "cy": -0.55, "b1": 0.0105, "b2": -0.0061, "k1": -0.0919367147, "k2": -0.0762807468,
      "k3": 0.1162639394, "k4": -0.0761413904, "p1": -0.0003134847, "p2": 0.0001164035}  # of a 106x79 image  # fmt: skip


def on_earth(viewmats, place=PLACE):
    """World-to-camera poses in geocentric axes of those in metres east, north and up of the first, which is at a place."""
    axes, first = east_north_up_at(place), np.linalg.inv(viewmats[0])[:3, 3]
    world = np.eye(4)  # from geocentric
    world[:3, :3], world[:3, 3] = axes, first - axes @ geocentric(place)
    return [viewmat @ world for viewmat in viewmats]


def test_cameras_of_a_georeferenced_chunk_come_back_in_east_north_and_up(tmp_path):
    shift, scale = geocentric(PLACE + [0.001, -0.002, 30.0]), 12.354192447331316
    poses = [in_chunk(viewmat, TURN, shift, scale) for viewmat in on_earth(VIEWMATS)]
    cameras = [camera(i, f"IR_{i:04d}", pose, f'sensor_id="{i % 2}" component_id="0"') for i, pose in enumerate(poses)]
    cameras += [
        camera(6, "off", poses[0], 'sensor_id="0" component_id="0" enabled="false"'),
        camera(7, "lost", None),
        camera(8, "slave", None, 'sensor_id="1" master_id="0"'),
    ]
    second = METASHAPE | {"f": 50.0, "b1": 0.5}
    path = write_metashape(
        tmp_path / "cameras.xml",
        cameras,
        [calibration({"f": 30.0}, of="initial") + calibration(METASHAPE), calibration(second, (80, 64))],
        transform_of(TURN, shift, scale),
        WGS_84,
    )
    found = read_metashape(path)
    assert (
        list(found.cameras) == [f"IR_{i:04d}" for i in range(6)]
        and found.metres_per_unit == 1.0
        and found.east_north_up
    )
    first = np.linalg.inv(VIEWMATS[0])[:3, 3]
    for (viewmat, lens), true, index in zip(found.cameras.values(), VIEWMATS, range(6), strict=True):
        centered = true.copy()
        centered[:3, 3] += true[:3, :3] @ first  # the world begins at the first camera
        np.testing.assert_allclose(viewmat, centered, atol=1e-6)
        wanted = (50.5, 50.0, 41.25, 31.25) if index % 2 else (38.0, 38.0, 21.25, 15.25)
        np.testing.assert_allclose((lens.fx, lens.fy, lens.cx, lens.cy), wanted, rtol=1e-12)
    np.testing.assert_allclose(found.origin, PLACE, atol=1e-8)
    assert "disabled" in found.left_out["off"] and "not aligned" in found.left_out["lost"]
    assert "follows camera 0 of a multi-camera system" in found.left_out["slave"]
    assert len(found.left_out) == 3 and not found.refused and "heights above the ellipsoid" in found.notes[-1]


def test_another_ellipsoid_tells_the_axes_and_no_place(tmp_path):
    shift = geocentric(PLACE)
    cameras = [camera(i, f"{i}", in_chunk(v, TURN, shift, 2.0)) for i, v in enumerate(on_earth(VIEWMATS))]
    bessel = WGS_84.replace('"WGS 84",6378137', '"Bessel 1841",6377397.155')
    path = write_metashape(
        tmp_path / "a.xml", cameras, [calibration(METASHAPE)], transform_of(TURN, shift, 2.0), bessel
    )
    found = read_metashape(path)
    assert found.east_north_up and found.origin is None and "Bessel 1841" in found.notes[-1]


@pytest.mark.parametrize(
    ("reference", "metres"), [(LOCAL, 1.0), (LOCAL.replace('"metre",1]', '"foot",0.3048]'), 0.3048), ("", None)]
)
def test_local_coordinates_come_back_as_they_are(tmp_path, reference, metres):
    shift, scale = np.array([10.0, -3.0, 2.0]), 0.7
    poses = (
        [in_chunk(viewmat, TURN, shift, scale) for viewmat in VIEWMATS] if reference else map(np.linalg.inv, VIEWMATS)
    )
    cameras = [camera(i, f"f{i}.tif", pose) for i, pose in enumerate(poses)]
    transform = transform_of(TURN, shift, scale) if reference else ""
    found = read_metashape(write_metashape(tmp_path / "a.xml", cameras, [calibration(METASHAPE)], transform, reference))
    np.testing.assert_allclose([viewmat for viewmat, _ in found.cameras.values()], VIEWMATS, atol=1e-6)
    assert (found.metres_per_unit, found.origin, found.east_north_up) == (metres, None, False)
    # A camera looks along z with y down: what lies before it and below its axis is seen below the middle of its image.
    viewmat, lens = found.cameras["f0.tif"]
    before = np.linalg.inv(viewmat) @ [0.0, 1.0, 4.0, 1.0]
    down = viewmat @ before
    assert down[2] > 0 and lens.fy * down[1] / down[2] + lens.cy > lens.cy


@pytest.mark.parametrize(
    ("values", "size", "off"),
    [(METASHAPE, (40, 32), 1e-6), (METASHAPE | {"b1": 1.5}, (40, 32), 1e-6), (K4, (106, 79), 0.005)],
)
def test_points_are_seen_where_the_manual_s_equations_put_them(tmp_path, values, size, off):
    path = write_metashape(tmp_path / "a.xml", [camera(0, "a", np.eye(4))], [calibration(values, size)])
    viewmat, lens = read_metashape(path).cameras["a"]
    rows, columns = np.mgrid[: size[1], : size[0]]
    straight = np.stack(
        [(columns + 0.5 - lens.cx) / lens.fx, (rows + 0.5 - lens.cy) / lens.fy, np.ones(rows.shape)], -1
    )
    points = 7.0 * straight.reshape(-1, 3)
    expected = seen_by_metashape({**values, "b2": 0.0}, points, size)
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), lens.matrix(), np.array(lens.distortion))[0][:, 0]
    assert np.abs(seen - expected).max() < off
    across, down, _ = undistortion_maps(lens)  # pixels from the middle of the first, in float32
    assert np.abs(np.stack([across, down], -1).reshape(-1, 2) + 0.5 - expected).max() < off + 1e-4
    assert np.abs(expected - points[:, :2] / points[:, 2:] * [lens.fx, lens.fy] - [lens.cx, lens.cy]).max() > 0.3
    told = "".join(read_metashape(path).notes)
    assert ("b2 is -0.0061, a skew that is left out" in told) == ("b2" in values)


def test_components_without_a_common_world_are_left_out_but_for_the_largest(tmp_path):
    poses = [np.linalg.inv(viewmat) for viewmat in VIEWMATS]
    cameras = [camera(i, f"{i}", pose, f'sensor_id="0" component_id="{int(i > 3)}"') for i, pose in enumerate(poses)]
    more = '<component id="1" label="Component 2"></component>'
    found = read_metashape(write_metashape(tmp_path / "a.xml", cameras, [calibration(METASHAPE)], more=more))
    assert list(found.cameras) == ["0", "1", "2", "3"] and "component 1, which nothing connects" in found.left_out["4"]


def test_images_of_one_name_are_refused_for_themselves_alone(tmp_path):
    poses = [np.linalg.inv(viewmat) for viewmat in VIEWMATS]
    cameras = [camera(i, "ab"[i > 0], pose) for i, pose in enumerate(poses[:3])]
    found = read_metashape(write_metashape(tmp_path / "a.xml", cameras, [calibration(METASHAPE)]))
    assert list(found.cameras) == ["a"] and "two cameras have the label 'b'" in found.refused["b"]


def test_a_lens_that_is_none_here_is_refused_for_its_own_images_alone(tmp_path):
    fish = calibration(METASHAPE, kind="equidistant_fisheye")
    skewed = calibration(METASHAPE | {"b2": -1.0})
    poses = [np.linalg.inv(viewmat) for viewmat in VIEWMATS]
    cameras = [camera(i, f"{i}", pose, f'sensor_id="{i}"') for i, pose in enumerate(poses[:4])]
    wild = calibration(METASHAPE | {"k4": 900.0, "k1": -40.0})
    found = read_metashape(write_metashape(tmp_path / "a.xml", cameras, [calibration(METASHAPE), fish, skewed, wild]))
    assert list(found.cameras) == ["0"]
    assert "type is equidistant_fisheye" in found.refused["1"]
    assert re.search(
        "a.xml: sensor 2: b2 is -1, a skew that moves pixels by up to 0.4.*Optimize Cameras without b1, b2",
        found.refused["2"],
    )
    assert re.search("a.xml: sensor 3: k4 is 900.*without k4", found.refused["3"])


DAMAGE = [
    ("<f>38.0</f>", "", "a.xml: sensor 0: f is 0, the focal length in pixels is needed; export the cameras from Metashape again"),
    ("<k1>-0.21", "<k1>-0,21", "a.xml: sensor 0: k1: could not convert string to float: '-0,21'; export"),
    ('<resolution width="40" height="32"/>', "", "a.xml: sensor 0: width of its resolution: 1 numbers are needed, it has 0"),
    ("<sensor id=\"0\"", "<sensor id=\"4\"", "a.xml: sensor 0 is not in the file; align"),
    ("<p2>-0.002</p2>", "<p2>-0.002</p2><p3>1.0</p3>", "a.xml: sensor 0: p3 is 1, .*Optimize Cameras without p3"),
]  # fmt: skip
BROKEN = [
    ("</document>", "", "a.xml is not readable XML .no element found.*export the cameras from Metashape again"),
    ("document", "html", "a.xml is a <html>, not a document of Metashape's cameras; export"),
    ("<transform>1.0 ", "<transform>", "a.xml: transform of camera f0: 16 numbers are needed, it has 15; export"),
    ("<transform>1.0 ", "<transform>nan ", "a.xml: transform of camera f0: .*it has some that are not finite"),
    ("<transform>1.0 ", "<transform>-1.0 ", "a.xml: transform of camera f0 is no pose: it mirrors the world"),
    (' label="f0"', "", "a.xml: camera 0 has no label, the name of its image; export"),
    (' label="f1"', ' label="f0"', "a.xml: two cameras have the label 'f0'.*rename one in Metashape"),
    ("<scale locked=\"true\">2.0", "<scale locked=\"true\">0.0", "component 0: scale is 0, a number above 0 is needed; ex"),
    ('component_id="0"', 'component_id="0" enabled="0"', "a.xml: none of its 2 cameras is aligned and enabled; align them"),
    ("</chunk>", "</chunk><chunk><cameras><camera/></cameras></chunk>", "a.xml has 2 chunks with cameras, .*export one"),
]  # fmt: skip


def damaged(tmp_path, before, after):
    cameras = [camera(i, f"f{i}", np.eye(4)) for i in range(2)]
    path = write_metashape(tmp_path / "a.xml", cameras, [calibration(METASHAPE)], transform_of(TURN, np.zeros(3), 2.0))
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))
    return path


@pytest.mark.parametrize(("before", "after", "says"), BROKEN)
def test_damaged_files_are_refused_with_the_key_and_a_remedy(tmp_path, before, after, says):
    with pytest.raises(SceneError, match=says):
        read_metashape(damaged(tmp_path, before, after))


@pytest.mark.parametrize(("before", "after", "says"), DAMAGE)
def test_damaged_calibrations_are_refused_with_the_key_and_a_remedy(tmp_path, before, after, says):
    found = read_metashape(damaged(tmp_path, before, after))
    assert not found.cameras and re.search(says, found.refused["f1"])
