"""TI-NSD, RGBT-Scenes and NTR."""

import cv2
import numpy as np
import pytest
from layouts import BOUNDS, HEIGHT, WIDTH, grey, names, points, viewmats, write_colmap, write_image, write_json

from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.palette import named
from heatsplat.datamodules.ntr import NTR
from heatsplat.datamodules.rgbt_scenes import RGBTScenes
from heatsplat.datamodules.ti_nsd import TINSD, frame_number


def loaded(loader, root, **options):
    module = loader(root=str(root), **options)
    module.setup()
    return module.scene


# TI-NSD ---------------------------------------------------------------------------------------------------------------


def test_ti_nsd_time_is_the_frame_number_over_the_registered_images(tmp_path):
    files = [f"{i}.png" for i in range(3, 19)]
    write_colmap(tmp_path / "car", files)
    scene = loaded(TINSD, tmp_path, scene="car")
    # string order: 10, 11, ..., 18, 3, ...: the first and the ninth name are test
    assert sorted(f.name for f in scene.test.frames) == sorted(sorted(files)[::8])
    assert scene.thermal_range is None and "thermal_range" not in scene.metadata
    times = {f.name: f.time_s for f in (*scene.train.frames, *scene.test.frames)}
    assert times["18.png"] - times["4.png"] == pytest.approx(14 / 15)
    assert "not seconds" in scene.notes["time_source"]


def test_ti_nsd_counts_registered_images_not_files(tmp_path):
    files = [f"{i}.png" for i in range(16)]
    write_colmap(tmp_path, files)
    write_image(tmp_path / "images" / "16.png", grey(0))
    scene = loaded(TINSD, tmp_path)
    assert max(scene.train.times_s) - min(scene.train.times_s) == pytest.approx((15 - 1) / 15)


def test_ti_nsd_seconds_can_be_given(tmp_path):
    write_colmap(tmp_path, [f"{i:04d}.png" for i in range(10)])
    scene = loaded(TINSD, tmp_path, seconds_per_frame=0.5)
    assert scene.train.times_s == pytest.approx([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 4.0])
    with pytest.raises(SceneError, match="data.seconds_per_frame must be positive"):
        TINSD(seconds_per_frame=0.0)


def test_ti_nsd_two_part_scenes_go_on_counting():
    assert frame_number("images/s1_12.png") == 12
    assert frame_number("s2_12.JPG") == 498
    assert frame_number("0007.png") == 7
    assert frame_number("frame_7.png") is None


def test_ti_nsd_names_that_are_no_numbers_have_no_time(tmp_path):
    write_colmap(tmp_path, names(9))
    scene = loaded(TINSD, tmp_path)
    assert "time" not in scene.metadata
    assert scene.notes["time_source"] == "none: frame_000.png is no frame number"


# RGBT-Scenes ----------------------------------------------------------------------------------------------------------


def write_rgbt(scene, count=9, suffix=".jpg"):
    files = names(count, "img_{:03d}" + suffix)
    write_colmap(scene, files, images=None)
    for i, name in enumerate(files):
        subset = "test" if i % 8 == 0 else "train"
        colours = np.ascontiguousarray(cv2.applyColorMap(grey(i), cv2.COLORMAP_INFERNO)[..., ::-1])
        # Some files of the set are PNG whatever their name says.
        for folder, pixels in (("thermal", colours), ("rgb", np.full((HEIGHT, WIDTH, 3), 20 + i, np.uint8))):
            path = scene / folder / subset / name
            write_image(path.with_suffix(".png"), pixels)
            path.with_suffix(".png").rename(path)
    return files


def test_rgbt_scenes_are_pseudo_colour_pairs(tmp_path):
    files = write_rgbt(tmp_path / "Truck")
    scene = loaded(RGBTScenes, tmp_path, scene="Truck")
    assert [f.name for f in scene.test.frames] == [files[0], files[8]]
    view = scene.train[0]
    assert view.thermal.shape == (HEIGHT, WIDTH, 3) and view.rgb.shape == (HEIGHT, WIDTH, 3)
    expected = cv2.applyColorMap(grey(1), cv2.COLORMAP_INFERNO)[..., ::-1] / 255.0
    np.testing.assert_allclose(view.thermal, expected, atol=1e-6)
    np.testing.assert_allclose(view.rgb * 255, 21, atol=1e-4)
    assert scene.thermal_range is None and "time" not in scene.metadata
    assert scene.notes["rgb"] == "9 of 9 images have a visible one"


def test_rgbt_scenes_options(tmp_path):
    write_rgbt(tmp_path)
    scene = loaded(RGBTScenes, tmp_path, thermal_channels=1, rgb=False, split="every_8th")
    assert scene.train[0].thermal.shape == (HEIGHT, WIDTH, 1) and scene.train[0].rgb is None
    assert "luma" in scene.notes["pseudo_colour"]


def test_rgbt_scenes_have_temperatures_where_palette_and_bounds_are_known(tmp_path):
    write_rgbt(tmp_path)
    write_json(tmp_path / "temperature_bounds.json", BOUNDS)
    scene = loaded(RGBTScenes, tmp_path, palette="opencv_inferno")
    assert (scene.thermal_range.min_c, scene.thermal_range.max_c) == (10, 40)
    np.testing.assert_allclose(255 * scene.train[0].thermal[..., 0], grey(1), atol=1.01)
    assert scene.train[0].rgb.shape == (HEIGHT, WIDTH, 3)
    colours = loaded(RGBTScenes, tmp_path)
    assert colours.thermal_range is None and "bounds_ignored" in colours.notes
    with pytest.raises(SceneError, match=r"img_00.\.jpg is not in the colours of jet: .*inferno fits"):
        loaded(RGBTScenes, tmp_path, palette="jet")
    with pytest.raises(SceneError, match="data.palette_hot=top says how a colour bar lies; give it as data.palette"):
        loaded(RGBTScenes, tmp_path, palette_hot="top")
    bar = np.repeat(named("opencv_inferno").curve(200)[::-1, None], 12, axis=1)
    write_image(tmp_path / "bar.png", np.rint(bar).astype(np.uint8))
    scene = loaded(RGBTScenes, tmp_path, palette="bar.png")
    np.testing.assert_allclose(255 * scene.train[0].thermal[..., 0], grey(1), atol=2.5)
    assert "bar.png" in scene.notes["palette"]


def test_rgbt_scenes_skip_what_is_listed_but_not_there(tmp_path):
    files = write_rgbt(tmp_path)
    (tmp_path / "thermal" / "train" / files[3]).unlink()
    scene = loaded(RGBTScenes, tmp_path)
    assert len(scene.train) == 6
    assert files[3] in scene.notes["images_missing"]


def test_rgbt_scenes_without_thermal_images(tmp_path):
    write_colmap(tmp_path, names(9))
    with pytest.raises(SceneError, match=r"thermal/ or a sparse model \(sparse/0\) is missing"):
        loaded(RGBTScenes, tmp_path)


# NTR ------------------------------------------------------------------------------------------------------------------


def write_ntr(scene, count=10, rgba=False, mesh=True, time=True, angle=0.9):
    frames = {"train": [], "test": []}
    for i, viewmat in enumerate(viewmats(count)):
        subset = "test" if i % 5 == 0 else "train"
        pixels = np.repeat(grey(i)[..., None], 4 if rgba else 3, axis=2)
        if rgba:
            pixels[..., 3] = 255
            pixels[:4, :, 3] = 0
        write_image(scene / subset / f"{i}.png", pixels)
        frame = {"file_path": f"./{subset}/{i}", "transform_matrix": np.linalg.inv(viewmat).tolist()}
        if time:
            frame["time"] = 100.0 + 600.5 * i
        frames[subset].append(frame)
    frames["train"][-1]["FovX"] = 0.5
    for subset, listed in frames.items():
        write_json(scene / f"transforms_{subset}.json", {"camera_angle_x": angle, "frames": listed})
    if mesh:
        lines = [f"v {x} {y} {z}" for x, y, z in points()]
        (scene / "mesh.obj").write_text("\n".join(["# a mesh", *lines, "vn 0 0 1", "f 1 2 3"]))
    return scene


def test_ntr_poses_are_opencv_and_times_are_seconds(tmp_path):
    scene = loaded(NTR, write_ntr(tmp_path / "s1").parent, scene="s1")
    assert len(scene.train) == 8 and len(scene.test) == 2
    for view in scene.train:
        i = int(view.frame.name.split("/")[1][:-4])
        np.testing.assert_allclose(view.camera.viewmat, viewmats(10)[i], atol=1e-9)
        np.testing.assert_allclose(view.thermal[..., 0] * 255, grey(i), atol=1e-4)
        assert view.time_s == pytest.approx(600.5 * (i - 1))
    assert (scene.thermal_range.min_c, scene.thermal_range.max_c, scene.ambient_c) == (10, 50, 36)
    np.testing.assert_allclose(scene.points, points(), atol=1e-6)


def test_ntr_fields_of_view_of_single_frames(tmp_path):
    scene = loaded(NTR, write_ntr(tmp_path))
    focal = {f.name: float(f.camera.K[0, 0]) for f in scene.train.frames}
    assert focal["train/9.png"] == pytest.approx(0.5 * WIDTH / np.tan(0.25))
    assert focal["train/8.png"] == pytest.approx(0.5 * WIDTH / np.tan(0.45))


def test_ntr_transparent_pixels_do_not_count(tmp_path):
    view = loaded(NTR, write_ntr(tmp_path, rgba=True)).train[0]
    assert not view.mask[:4].any() and view.mask[4:].all()


def test_ntr_bounds_are_options(tmp_path):
    scene = loaded(NTR, write_ntr(tmp_path), min_c=-20.0, max_c=20.0, ambient_c=None)
    assert scene.thermal_range.min_c == -20 and scene.ambient_c is None
    with pytest.raises(SceneError, match="data.min_c and data.max_c: the minimum 50.0 °C lies above"):
        NTR(min_c=50.0, max_c=10.0)


def test_ntr_without_mesh_or_times(tmp_path):
    scene = loaded(NTR, write_ntr(tmp_path, mesh=False, time=False), random_points=50)
    assert scene.points.shape == (50, 3) and "no mesh.obj" in scene.notes["points_source"]
    assert "time" not in scene.metadata


def test_ntr_missing_and_damaged_files(tmp_path, caplog):
    write_ntr(tmp_path)
    (tmp_path / "train" / "1.png").unlink()
    assert loaded(NTR, tmp_path).notes["images_missing"] == "1 of 10 frames without an image, dropped: train/1"
    assert f"{tmp_path}: 1 of 10 frames without an image, dropped: train/1; put" in caplog.text
    (tmp_path / "mesh.obj").write_text("v 1 2\n")
    with pytest.raises(SceneError, match="mesh.obj, line 1: 'v 1 2' is no vertex"):
        loaded(NTR, tmp_path)
    (tmp_path / "transforms_test.json").unlink()
    with pytest.raises(SceneError, match="transforms_train.json and transforms_test.json is missing"):
        loaded(NTR, tmp_path)
