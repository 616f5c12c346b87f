import numpy as np
import pytest
from layouts import (
    BOUNDS,
    FOCAL,
    HEIGHT,
    WIDTH,
    grey,
    names,
    points,
    viewmats,
    write_colmap,
    write_image,
    write_json,
    write_thermoscenes,
)
from plyfile import PlyData, PlyElement

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.lens import lens_of
from heatsplat.datamodules.formats.nerfstudio import lens_in, read_transforms, viewmat_of
from heatsplat.datamodules.thermoscenes import ThermoScenes

STEMS = [f"frame_train_{i:05d}" for i in range(1, 7)] + [f"frame_eval_{i:05d}" for i in range(1, 3)]
# nerfstudio's turn of COLMAP's world: x and y change places, z changes sign (a rotation).
TURN = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]], dtype=np.float64)
DISTORTION = {"k1": -0.15, "k2": 0.04, "p1": 0.01, "p2": -0.02}


def loaded(root, **options):
    module = ThermoScenes(root=str(root), **{"random_points": 500, **options})
    module.setup()
    return module.scene


@pytest.mark.parametrize("file", ["transforms_thermal.json", "transforms.json", "transforms_other.json"])
def test_cameras_split_bounds_and_pixels(tmp_path, file):
    write_thermoscenes(tmp_path / "freezer", STEMS, file=file)
    scene = loaded(tmp_path, scene="freezer")
    assert len(scene.train) == 6 and len(scene.test) == 2
    assert all("train" in f.name for f in scene.train.frames) and all("eval" in f.name for f in scene.test.frames)
    for view in scene.train:
        i = STEMS.index(view.frame.name[:-4])
        np.testing.assert_allclose(view.camera.viewmat, viewmats(8)[i], atol=1e-9)
        np.testing.assert_allclose(view.thermal[..., 0] * 255, grey(i), atol=1e-4)
    assert scene.train[0].camera.K.tolist() == [[FOCAL, 0, 20.5], [0, FOCAL + 2, 15.0], [0, 0, 1]]
    assert scene.train[0].rgb.shape == (HEIGHT, WIDTH, 3)
    assert (scene.thermal_range.min_c, scene.thermal_range.max_c) == (10, 40)
    assert "time" not in scene.metadata


def test_distortion_is_taken_out(tmp_path):
    """The same picture through the same lens as written by COLMAP's conventions."""
    from heatsplat.datamodules.formats.images import undistorted

    write_thermoscenes(tmp_path, STEMS, distortion=DISTORTION)
    scene = loaded(tmp_path)
    lens = lens_of("OPENCV", (FOCAL, FOCAL + 2, 20.5, 15.0, -0.15, 0.04, 0.01, -0.02), WIDTH, HEIGHT, "test")
    view = next(v for v in scene.train if v.frame.name.startswith(STEMS[2]))
    expected = undistorted(grey(2), lens)
    np.testing.assert_allclose(view.thermal[..., 0] * 255, expected, atol=1e-4)
    assert np.abs(expected.astype(int) - grey(2)).max() > 5
    assert scene.notes["distortion"].startswith("8 images undistorted")


def test_lenses_of_one_frame_and_fields_of_view(tmp_path):
    write_thermoscenes(tmp_path, STEMS)
    transforms = read_transforms(tmp_path / "transforms_thermal.json")
    frame = {**transforms.frames[0], "fl_x": 99.0, "k1": 0.1}
    lens = lens_in(transforms, frame, lambda: (1, 1))
    assert lens.fx == 99 and lens.fy == FOCAL + 2 and lens.distortion[0] == 0.1
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        del transforms.values[key]
    lens = lens_in(transforms, {**transforms.frames[0], "camera_angle_x": np.pi / 2}, lambda: (80, 60))
    assert (lens.fx, lens.fy, lens.cx, lens.cy) == (pytest.approx(40), pytest.approx(40), 40, 30)
    with pytest.raises(SceneError, match="no focal length; fl_x or camera_angle_x is needed"):
        lens_in(transforms, transforms.frames[0], lambda: (80, 60))


def test_colmap_points_move_into_the_world_of_the_json(tmp_path):
    write_thermoscenes(tmp_path, STEMS, turn=TURN)
    write_colmap(tmp_path, [f"{s}.JPG" for s in STEMS], place="colmap/sparse/0", images=None)
    scene = loaded(tmp_path)
    assert scene.notes["points_source"].startswith("colmap/sparse/0")
    # Points must project where COLMAP's own cameras see them.
    for view in scene.train:
        i = STEMS.index(view.frame.name[:-4])
        theirs = viewmats(8)[i][:3, :3] @ points().T + viewmats(8)[i][:3, 3:]
        ours = (
            view.camera.viewmat[:3, :3].numpy() @ scene.points.double().numpy().T + view.camera.viewmat[:3, 3:].numpy()
        )
        np.testing.assert_allclose(np.sort(ours, axis=1), np.sort(theirs, axis=1), atol=1e-5)


def test_a_model_in_another_world_is_not_used(tmp_path):
    write_thermoscenes(tmp_path, STEMS)
    write_colmap(tmp_path, [f"{s}.JPG" for s in STEMS], place="colmap/sparse/0", images=None, center=(5, 0, 0))
    scene = loaded(tmp_path)
    assert "random points" in scene.notes["points_source"]
    assert "cameras lie up to 5 units elsewhere" in scene.notes["points_source"]


def test_a_point_cloud_of_the_json_is_used(tmp_path):
    write_thermoscenes(tmp_path, STEMS, extra={"ply_file_path": "sparse_pc.ply"})
    rows = [(*map(float, p), 10, 20, 255) for p in points()]
    fields = [("x", "f4"), ("y", "f4"), ("z", "f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")]
    PlyData([PlyElement.describe(np.array(rows, dtype=fields), "vertex")]).write(str(tmp_path / "sparse_pc.ply"))
    scene = loaded(tmp_path)
    np.testing.assert_allclose(scene.points, points(), atol=1e-6)
    np.testing.assert_allclose(scene.point_colors[0] * 255, [10, 20, 255], atol=1e-4)
    (tmp_path / "sparse_pc.ply").write_text("not a cloud")
    with pytest.raises(SceneError, match="sparse_pc.ply is no readable point cloud"):
        loaded(tmp_path)


def test_without_points_random_ones_lie_where_the_cameras_look(tmp_path):
    write_thermoscenes(tmp_path, STEMS)
    scene, again, other = loaded(tmp_path), loaded(tmp_path), loaded(tmp_path, seed=1)
    assert scene.points.shape == (500, 3)
    assert scene.points.mean(0).norm() < 1.0  # cameras at distance 4 look at the origin
    assert (scene.points == again.points).all() and not (scene.points == other.points).all()
    assert "500 random points" in scene.notes["points_source"]


def test_bounds_in_the_wrong_order_are_swapped_and_noted(tmp_path):
    write_thermoscenes(tmp_path, STEMS, bounds={"absolute_min_temperature": 30, "absolute_max_temperature": -5})
    scene = loaded(tmp_path)
    assert (scene.thermal_range.min_c, scene.thermal_range.max_c) == (-5, 30)
    assert "swapped" in scene.notes["bounds_source"]


def test_equal_bounds_are_refused(tmp_path):
    write_thermoscenes(tmp_path, STEMS, bounds={"absolute_min_temperature": 30, "absolute_max_temperature": 30})
    with pytest.raises(SceneError, match="minimum and maximum are both 30.0 °C"):
        loaded(tmp_path)


def test_without_bounds_there_is_no_celsius(tmp_path):
    scene = loaded(write_thermoscenes(tmp_path, STEMS, bounds=None))
    assert scene.thermal_range is None
    assert scene.notes["bounds_source"] == "none: there is no temperature_bounds.json"


def test_lists_in_the_json_win_over_names(tmp_path):
    lists = {
        "train_filenames": [f"images/{s}.JPG" for s in STEMS[2:]],
        "test_filenames": [f"images/{s}.JPG" for s in STEMS[:2]],
    }
    scene = loaded(write_thermoscenes(tmp_path, STEMS, extra=lists))
    assert {f.name[:-4] for f in scene.test.frames} == set(STEMS[:2])
    assert "lists in transforms_thermal.json" in scene.notes["split_source"]


def test_names_that_say_nothing_leave_every_8th_frame_out_and_half_of_them_is_too_little(tmp_path):
    write_thermoscenes(tmp_path / "a", [f"frame_{i}" for i in range(9)])
    scene = loaded(tmp_path / "a")
    assert [f.name for f in scene.test.frames] == ["frame_0.PNG", "frame_8.PNG"]
    assert scene.notes["split_assumed"].startswith("every 8th frame is test: neither names nor transforms_thermal.json")
    write_thermoscenes(tmp_path / "b", [f"frame_{i}" for i in range(8)] + ["train_8"])
    with pytest.raises(SceneError, match="data.split=names: frame_0.PNG says neither.*data.split=every_8th"):
        loaded(tmp_path / "b")


def test_the_thermal_image_is_found_beside_the_visible_one(tmp_path):
    write_thermoscenes(tmp_path, STEMS)
    transforms = read_transforms(tmp_path / "transforms_thermal.json")
    for frame in transforms.frames:
        del frame["thermal_file_path"]
    write_json(tmp_path / "transforms_thermal.json", {**transforms.values, "frames": transforms.frames})
    view = loaded(tmp_path).train[0]
    assert view.frame.name.endswith(".PNG") and view.rgb is not None


def test_visible_images_never_stand_in_for_thermal_ones(tmp_path):
    write_thermoscenes(tmp_path, STEMS)
    for file in (tmp_path / "thermal").iterdir():
        file.unlink()
    with pytest.raises(SceneError, match="none of the 8 frames of .* has a thermal image"):
        loaded(tmp_path)


def test_a_missing_image_is_dropped_and_told(tmp_path, caplog):
    write_thermoscenes(tmp_path, STEMS)
    (tmp_path / "thermal" / f"{STEMS[0]}.PNG").unlink()
    scene = loaded(tmp_path)
    assert len(scene.train) == 5
    assert scene.notes["images_missing"].startswith(
        "1 of 8 frames without a thermal image, dropped: images/frame_train_00001"
    )
    assert f"{tmp_path}: 1 of 8 frames without a thermal image, dropped: images/frame_train_00001" in caplog.text


def test_the_paired_layout_is_read_too(tmp_path):
    files = names(9)
    write_colmap(tmp_path, files, images=None)
    write_json(tmp_path / "temperature_bounds.json", BOUNDS)
    for i, name in enumerate(files):
        write_image(tmp_path / "thermal" / ("test" if i % 8 == 0 else "train") / name, grey(i))
    scene = loaded(tmp_path)
    assert [f.name for f in scene.test.frames] == [files[0], files[8]]
    assert scene.thermal_range.max_c == 40


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "camera model EQUIRECTANGULAR is not supported"),
        ({"applied_transform": [[1, 0], [0, 1]]}, "applied_transform is no pose: it is \\[2, 2\\], 4x4"),
        ({"frames": []}, "has no frames"),
        ({"frames": [{"file_path": "a.png"}]}, "frame 0 has no key 'transform_matrix'; it has file_path"),
    ],
)
def test_bad_transforms_are_refused(tmp_path, change, message):
    write_thermoscenes(tmp_path, STEMS, extra=change)
    if "applied_transform" in change:
        write_colmap(tmp_path, [f"{s}.JPG" for s in STEMS], place="colmap/sparse/0", images=None)
    with pytest.raises(SceneError, match=message):
        loaded(tmp_path)


@pytest.mark.parametrize("matrix", [np.zeros((4, 4)), np.eye(3), np.full((4, 4), np.nan)])
def test_matrices_that_are_no_poses_are_refused(tmp_path, matrix):
    transforms = read_transforms(write_thermoscenes(tmp_path, STEMS) / "transforms_thermal.json")
    with pytest.raises(SceneError, match="transform_matrix of x is no pose"):
        viewmat_of(transforms, {"file_path": "x", "transform_matrix": matrix.tolist()}, opengl=True)


def test_a_folder_without_a_scene_says_what_is_missing(tmp_path):
    (tmp_path / "s").mkdir()
    with pytest.raises(SceneError, match="data.scene=s: transforms_thermal.json is missing; .*holds nothing"):
        loaded(tmp_path, scene="s")
