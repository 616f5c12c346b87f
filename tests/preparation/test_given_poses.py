"""Cameras of other tools, taken as they are: what was given is what the prepared scene has."""

import csv
import json

import numpy as np
import pytest
import torch
from aligned import (
    METASHAPE,
    WGS_84,
    calibration,
    camera,
    east_north_up_at,
    geocentric,
    in_chunk,
    transform_of,
    write_metashape,
    write_pix4d,
)
from recordings import write_flir, write_images

from heatsplat.contracts import SceneError
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.colmap import read_model, write_model
from heatsplat.doctor.base import material_of
from heatsplat.export.place import place_of
from heatsplat.preparation.given_poses import GivenPoses
from heatsplat.preparation.prepare import prepare

pytestmark = pytest.mark.usefixtures("dots_for_pictures")
PLAIN = {"conditions": {}, "uncertainty": {}, "counts": {}}
OPENCV = ("OPENCV", (60.0, 61.0, 39.0, 33.0, 0.05, -0.01, 0.001, 0.002), 80, 64)  # at twice the frames' size
FISHEYE = ("OPENCV_FISHEYE", (30.0, 30.0, 20.0, 16.0, 0.01, 0.0, 0.0, 0.0), 40, 32)


def pose(index: int) -> np.ndarray:
    angle = 0.05 * index
    viewmat = np.eye(4)
    viewmat[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    viewmat[:3, 3] = [0.1 * index, -0.02 * index, 4.0]
    return viewmat


def test_a_model_of_the_camera_s_files_becomes_that_of_the_prepared_images(tmp_path):
    source = write_flir(tmp_path / "files", 5)
    names = [f"images/IR_{i:04d}.JPG" for i in (0, 1, 2, 4)]  # in a folder, and in another case
    points = np.random.default_rng(0).uniform(-1, 1, (30, 3))
    given = {name: pose(i) for i, name in enumerate([*names, "images/other.jpg"])}
    kinds = {name: int(name == names[1]) for name in given}
    model = tmp_path / "tool" / "sparse" / "0"
    write_model(model, given, [OPENCV, FISHEYE], points, np.full((30, 3), 51), camera_of=kinds)
    target = tmp_path / "scene"
    page = prepare(str(source), target, **PLAIN, poses=GivenPoses(str(tmp_path / "tool")))
    found = read_model(target)
    assert found.names == ("IR_0000.tiff", "IR_0001.tiff", "IR_0002.tiff", "IR_0004.tiff")
    np.testing.assert_allclose(np.stack(found.viewmats), np.stack([pose(i) for i in range(4)]), atol=1e-12)
    stored = {lens.model: lens for lens in read_model(tmp_path / "tool").lenses}
    for place, lens in enumerate(found.lenses):
        wanted = stored["OPENCV_FISHEYE" if place == 1 else "OPENCV"]
        size = (lens.fx, lens.fy, lens.cx, lens.cy, lens.width, lens.height, lens.fisheye)
        assert size == (wanted.fx, wanted.fy, wanted.cx, wanted.cy, wanted.width, wanted.height, wanted.fisheye)
        np.testing.assert_array_equal(lens.distortion, wanted.distortion)
    np.testing.assert_allclose(np.sort(found.points, 0), np.sort(points, 0))
    text = page.read_text()
    assert "4 of 5 frames have a camera" in text and "- IR_0003: the model has no camera for it" in text
    assert "1 of its cameras belong to no frame" in text and (target / "report" / "cameras.png").is_file()
    scene = Colmap(root=str(target)).scene
    assert len(scene.train) + len(scene.test) == 4 and scene.thermal_range is not None
    said = prepare(str(source), target, **PLAIN, poses=GivenPoses(str(model))).read_text()  # its own folder is as good
    assert "4 of 5 frames have a camera" in said


@pytest.mark.parametrize("place", ["sparse/1", "exported", "sparse"])
def test_the_folder_of_a_model_may_be_called_anything(tmp_path, place):
    """COLMAP exports a model into any folder, and the larger one may be sparse/1."""
    source = write_flir(tmp_path / "files", 3)
    points = np.zeros((4, 3)), np.zeros((4, 3))
    own = tmp_path / "tool" / place
    write_model(
        own if place != "sparse" else own / "0", {f"IR_{i:04d}.jpg": pose(i) for i in range(3)}, [FISHEYE], *points
    )
    if place == "sparse/1":
        write_model(tmp_path / "tool" / "sparse" / "0", {"IR_0000.jpg": pose(0)}, [FISHEYE], *points)
    page = prepare(str(source), tmp_path / "scene", **PLAIN, poses=GivenPoses(str(own)))
    assert "3 of 3 frames have a camera" in page.read_text()


def test_a_transforms_file_without_points_trains_from_random_ones_which_nothing_is_judged_by(tmp_path):
    source = write_flir(tmp_path / "files", 9)
    turned = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": f"./images/IR_{i:04d}.png", "transform_matrix": (np.linalg.inv(pose(i)) @ turned).tolist()}
        for i in range(9)
    ]
    (tmp_path / "tool").mkdir()
    values = {"fl_x": 38.0, "k1": 0.02, "frames": frames}
    (tmp_path / "tool" / "transforms.json").write_text(json.dumps(values))
    target = tmp_path / "scene"
    page = prepare(str(source), target, **PLAIN, poses=GivenPoses(str(tmp_path / "tool")))
    said = "The cameras come without points, and only 0 could be triangulated from 0 matched pairs of features"
    assert f"## Findings\n\n- {said}" in page.read_text() and "training starts from random ones" in page.read_text()
    np.testing.assert_allclose(read_model(target).viewmats[3], pose(3), atol=1e-12)
    scene = Colmap(root=str(target), random_points=50).scene
    assert scene.points.shape == (50, 3) and "the sparse model has none" in scene.notes["points_source"]
    assert scene.notes["time_source"] == "frames.csv"
    assert material_of(scene).points is None and material_of(scene).tracks is None


def test_what_does_not_belong_to_the_recording_is_refused_by_name(tmp_path):
    source = write_flir(tmp_path / "files", 3)

    def refused(said: str) -> None:
        with pytest.raises(SceneError, match=said):
            prepare(str(source), tmp_path / "scene", **PLAIN, poses=GivenPoses(str(tmp_path / "tool")))

    write_images(tmp_path / "tool", {})
    refused("poses.model=.*tool holds none of them: the folder of a COLMAP model .sparse/0. or")
    model = tmp_path / "tool" / "sparse" / "0"
    points = np.zeros((4, 3)), np.zeros((4, 3))
    write_model(model, {"a/left_1.png": pose(0)}, [FISHEYE], *points)
    refused(
        "none of the 1 cameras of .*sparse/0 belongs to a frame: it has names like 'a/left_1.png', the recording like 'IR_0"
    )
    write_model(model, {"IR_0001.jpg": pose(0)}, [("PINHOLE", (30.0, 30.0, 16.0, 16.0), 32, 32)], *points)
    refused("camera of IR_0001.jpg is one of 32x32 pixels, the frame has 40x32")
    assert len(list((tmp_path / "scene" / "images").glob("*.tiff"))) == 3  # the temperatures stay


def test_a_visible_camera_s_pose_and_lens_are_not_taken_for_the_thermal_one_s(tmp_path):
    source = write_flir(tmp_path / "files" / "thermal", 3)
    names = [f"IR_{i:04d}" for i in range(3)]
    points = np.zeros((4, 3)), np.zeros((4, 3))
    thermal = ("PINHOLE", (30.0, 30.0, 20.0, 16.0), 40, 32)
    visible = ("PINHOLE", (900.0, 900.0, 400.0, 320.0), 800, 640)  # of the same shape

    def prepared(folders: tuple[str, str]):
        cameras, kinds = {}, {}
        for k, folder in enumerate(folders):
            cameras |= {f"{folder}/{name}.{('png', 'jpg')[k]}": pose(i + 10 * k) for i, name in enumerate(names)}
        kinds = {name: int(name.endswith("jpg")) for name in cameras}
        write_model(tmp_path / "tool" / "sparse" / "0", cameras, [thermal, visible], *points, camera_of=kinds)
        prepare(str(source), tmp_path / "scene", **PLAIN, poses=GivenPoses(str(tmp_path / "tool")))
        return read_model(tmp_path / "scene")

    for folders in (("thermal", "visible"), ("Thermal", "a")):
        found = prepared(folders)
        assert found.names == tuple(f"{name}.tiff" for name in names)
        np.testing.assert_allclose(np.stack(found.viewmats), np.stack([pose(i) for i in range(3)]), atol=1e-12)
        assert all(lens.fx == 30.0 for lens in found.lenses)
    with pytest.raises(
        SceneError, match="ir/IR_0000.png and rgb/IR_0000.jpg may both be the camera of .*IR_0000.jpg; give"
    ):
        prepared(("ir", "rgb"))


def test_greys_that_become_temperatures_leave_no_image_under_the_same_name(tmp_path):
    grey = np.random.default_rng(0).integers(0, 255, (3, 32, 40)).astype(np.uint8)
    source = write_images(tmp_path / "files", {f"f{i}.png": image for i, image in enumerate(grey)})
    kind = ("PINHOLE", (30.0, 30.0, 20.0, 16.0), 40, 32)
    points = np.zeros((4, 3)), np.zeros((4, 3))
    write_model(tmp_path / "tool" / "sparse" / "0", {f"f{i}.png": pose(i) for i in range(3)}, [kind], *points)
    for ending, bounds in (("png", None), ("tiff", [10.0, 30.0]), ("png", None)):
        given = GivenPoses(str(tmp_path / "tool"))
        prepare(str(source), tmp_path / "scene", **PLAIN, bounds_c=bounds, poses=given)
        assert read_model(tmp_path / "scene").names == tuple(f"f{i}.{ending}" for i in range(3))
        images = {p.name for p in (tmp_path / "scene" / "images").glob("*") if p.suffix != ".json"}
        assert images == {f"f{i}.{ending}" for i in range(3)}
        assert (tmp_path / "scene" / "temperature_bounds.json").exists() == (bounds is not None)


def test_cameras_of_metashape_place_the_scene_on_the_earth_by_its_reference(tmp_path):
    warp = pytest.importorskip("rasterio.warp", reason="rasterio is not installed (pip install -e '.[dev]')")
    source = write_flir(tmp_path / "files", 6)  # whose own fixes are 26 km away
    place, viewmats = np.array([51.2, 7.25, 180.0]), [pose(i) for i in range(5)]
    axes, centers = east_north_up_at(place), np.stack([np.linalg.inv(viewmat)[:3, 3] for viewmat in viewmats])
    shift, world = geocentric(place), np.eye(4)
    world[:3, :3], world[:3, 3] = axes, -axes @ shift
    poses = [in_chunk(viewmat @ world, np.eye(3), shift, 3.0) for viewmat in viewmats]
    cameras = [camera(i, f"IR_{i:04d}", chunk) for i, chunk in enumerate(poses)]
    cameras.append(camera(5, "IR_0005", poses[0], 'sensor_id="0" enabled="false"'))
    given = tmp_path / "tool" / "cameras.xml"
    write_metashape(given, cameras, [calibration(METASHAPE)], transform_of(np.eye(3), shift, 3.0), WGS_84)
    for model in (given, given.parent):
        page = prepare(str(source), tmp_path / "scene", **PLAIN, poses=GivenPoses(str(model)))
    text = page.read_text()
    assert "5 of 6 frames have a camera" in text and "- IR_0005: it is disabled in Metashape" in text
    assert "World: east, north, up in metres of the first camera" in text and "The cameras come without points" in text
    assert json.loads((tmp_path / "scene" / "world.json").read_text()) == {
        "metres_per_unit": 1.0,
        "axes": "east, north, up",
    }
    rows = {row["file"]: row for row in csv.DictReader((tmp_path / "scene" / "frames.csv").open())}
    assert rows["IR_0005.tiff"]["latitude_deg"] == "" and rows["IR_0005.tiff"]["time"]
    data = Colmap(root=str(tmp_path / "scene"), random_points=50, split="all").scene
    found = place_of(data, "auto")
    at = torch.stack([frame.camera.center for frame in data.train.frames])
    (easting,), (northing,) = warp.transform("EPSG:4326", found.crs, [7.25], [51.2])
    away = found(at) - torch.tensor([easting, northing, 180.0], dtype=torch.float64)
    numbers = [int(frame.name[3:7]) for frame in data.train.frames]
    assert np.abs(away.numpy() - centers[numbers]).max() < 0.02  # of decimetres, and grid north is 1.4 degrees off
    latitudes = [float(rows[f"IR_{i:04d}.tiff"]["latitude_deg"]) for i in range(5)]
    np.testing.assert_allclose(np.array(latitudes) - 51.2, centers[:, 1] / 111_250.0, atol=1e-9)


def test_cameras_of_pix4d_and_files_of_none_of_them(tmp_path):
    source = write_flir(tmp_path / "files", 3)
    folder = tmp_path / "params"
    path = write_pix4d(folder, {f"IR_{i:04d}.JPG": pose(i) for i in range(2)})
    page = prepare(str(source), tmp_path / "scene", **PLAIN, poses=GivenPoses(str(folder)))
    assert (
        "2 of 3 frames have a camera" in page.read_text() and "- IR_0002: the model has no camera" in page.read_text()
    )
    np.testing.assert_allclose(read_model(tmp_path / "scene").viewmats[1], pose(1), atol=1e-9)
    assert not (tmp_path / "scene" / "world.json").exists()

    def refused(model, said):
        with pytest.raises(SceneError, match=said):
            prepare(str(source), tmp_path / "scene", **PLAIN, poses=GivenPoses(str(model)))

    fish = calibration(METASHAPE, kind="spherical")
    xml = write_metashape(folder / "cameras.xml", [camera(i, f"IR_{i:04d}", pose(i)) for i in range(2)], [fish])
    refused(
        folder, "params holds several files of cameras .cameras.xml, flight_calibrated_camera_parameters.txt.; give one"
    )
    refused(xml, "cameras.xml: sensor 0: type is spherical, and only frame is read")
    write_metashape(xml, [camera(0, "IR_0000", None), camera(1, "other", pose(0))], [calibration(METASHAPE)])
    refused(
        xml, "cameras.xml has no camera of a frame: of 1 none, such as IR_0000, because it is not aligned in Metashape"
    )
    refused(source / "IR_0000.jpg", "poses.model=.*IR_0000.jpg is none of them: the folder of a COLMAP model")
    refused(tmp_path / "nowhere", "poses.model=.*nowhere does not exist: ")
    assert path.is_file()
