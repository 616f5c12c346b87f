import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from camera_files import flir_jpeg, palette_record, raw_for, temperatures
from layouts import (
    BOUNDS,
    FOCAL,
    HEIGHT,
    WIDTH,
    grey,
    names,
    viewmats,
    write_colmap,
    write_image,
    write_json,
)

from heatsplat.contracts import SceneError
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.formats.colmap import find_model, read_model
from heatsplat.datamodules.formats.palette import named

M3T = Path(__file__).parents[3] / "shared" / "data" / "m3t_heath"
needs_m3t = pytest.mark.skipif(not M3T.is_dir(), reason="real DJI data is not at ../shared/data/m3t_heath")


def loaded(root, **options):
    module = Colmap(root=str(root), **options)
    module.setup()
    return module.scene


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0"])
def test_cameras_points_and_pixels_come_back(tmp_path, text, place):
    files = names(9)
    write_colmap(tmp_path / "s", files, text=text, place=place)
    write_json(tmp_path / "s" / "temperature_bounds.json", BOUNDS)
    scene = loaded(tmp_path, scene="s")
    assert scene.name == "s"
    assert len(scene.train) == 7 and len(scene.test) == 2
    for view in scene.train:
        i = files.index(view.frame.name)
        np.testing.assert_allclose(view.camera.viewmat, viewmats(9)[i], atol=1e-9)
        np.testing.assert_allclose(view.thermal[..., 0] * 255, grey(i), atol=1e-4)
    K = scene.train[0].camera.K
    assert K.tolist() == [[FOCAL, 0, 20.5], [0, FOCAL + 2, 15.0], [0, 0, 1]]
    assert scene.points.shape == (30, 3) and scene.point_colors.max() == pytest.approx(128 / 255)
    assert (scene.thermal_range.min_c, scene.thermal_range.max_c) == (10, 40)
    json.dumps(scene.notes)  # the report writes them


@pytest.mark.parametrize("place", ["thermal/", "C:\\Flüge\\", "/home/me/"])
def test_images_of_a_model_that_names_other_folders_are_known_by_their_files(tmp_path, place, caplog):
    """As tools write it that name whole paths of the computer on which they ran."""
    files = names(9)
    write_colmap(tmp_path, files)
    expected = {view.frame.name: view.camera.viewmat for view in loaded(tmp_path).train}
    write_colmap(tmp_path / "other", [place + file for file in files], images=None, text=True)
    shutil.rmtree(tmp_path / "sparse")
    shutil.move(tmp_path / "other" / "sparse", tmp_path / "sparse")
    with caplog.at_level("INFO"):
        scene = loaded(tmp_path)
    assert "known by the names of their files" in caplog.text
    assert {view.frame.name: view.camera.viewmat for view in scene.train}.keys() == expected.keys()
    for view in scene.train:
        np.testing.assert_allclose(view.camera.viewmat, expected[view.frame.name], atol=1e-9)


def test_two_cameras_of_a_model_in_folders_of_their_own_are_not_taken_for_each_other(tmp_path):
    write_colmap(tmp_path, ["thermal/a.png", "thermal/b.png", "visible/a.png", "visible/b.png"])
    for file in ("a.png", "b.png"):
        shutil.move(tmp_path / "images" / "thermal" / file, tmp_path / "images" / file)
    shutil.rmtree(tmp_path / "images" / "visible")
    with pytest.raises(
        SceneError, match="none of the 4 images .* has names like 'thermal/a.png', the folder like 'a.png'"
    ):
        loaded(tmp_path)


def test_where_images_lie_is_told_where_their_folder_is_not_there(tmp_path):
    write_colmap(tmp_path, names(3), images="thermal")
    with pytest.raises(SceneError, match="data.images=images: .*/images does not exist; images lie in thermal/$"):
        loaded(tmp_path)
    assert loaded(tmp_path, images="thermal").train


def test_what_is_nearly_a_model_is_told(tmp_path):
    write_colmap(tmp_path / "s", names(3))
    (tmp_path / "s" / "sparse" / "0").rename(tmp_path / "s" / "sparse" / "1")
    for options in ({}, {"scene": "s"}):
        with pytest.raises(SceneError, match="sparse/1 is a model: rename it to sparse/0"):
            loaded(tmp_path if options else tmp_path / "s", **options)
    (tmp_path / "s" / "sparse" / "1").rename(tmp_path / "s" / "sparse" / "0")
    (tmp_path / "s" / "sparse" / "0" / "cameras.bin").unlink()
    with pytest.raises(
        SceneError, match="sparse/0 has images, and neither cameras.bin nor cameras.txt: copy the model"
    ):
        loaded(tmp_path / "s")


@pytest.mark.parametrize("text", [False, True])
def test_names_may_have_spaces(tmp_path, text):
    files = names(9, "flight 2/frame {:03d} T.png")
    write_colmap(tmp_path, files, text=text)
    assert [frame.name for frame in loaded(tmp_path).test.frames] == [files[0], files[8]]


@pytest.mark.parametrize("text", [False, True])
def test_names_may_have_folders_in_the_way_of_windows(tmp_path, text):
    write_colmap(tmp_path, names(9, "left\\frame_{:03d}.png"), text=text, images=None)
    for i, name in enumerate(names(9, "left/frame_{:03d}.png")):
        write_image(tmp_path / "images" / name, grey(i))
    assert [frame.name for frame in loaded(tmp_path).test.frames] == ["left/frame_000.png", "left/frame_008.png"]


def test_the_root_may_be_the_scene_and_relative(tmp_path, monkeypatch):
    write_colmap(tmp_path / "data" / "s", names(9))
    monkeypatch.chdir(tmp_path)
    assert loaded("data/s").name == "s"


def test_temperatures_of_counts_survive_to_the_last_digit(tmp_path):
    counts = [(19000 + grey(i, np.uint16) // 50).astype(np.uint16) for i in range(9)]
    write_colmap(tmp_path, names(9))
    for name, pixels in zip(names(9), counts, strict=True):
        write_image(tmp_path / "raw16" / name, pixels)
    scene = loaded(tmp_path, raw="raw16", bounds_c=[20.0, 50.0])
    celsius = scene.thermal_range.to_celsius(scene.train[0].thermal[..., 0].double())
    np.testing.assert_allclose(celsius, counts[1] / 64 - 273.15, atol=5e-6)
    assert "raw16" in scene.notes["encoding"] and scene.notes["bounds_source"] == "data.bounds_c"


def test_float_tiffs_are_celsius(tmp_path):
    files = names(9, "f_{}.tiff")
    pixels = [(15 + grey(i) / 16).astype(np.float32) for i in range(9)]
    write_colmap(tmp_path, files, pixels=pixels)
    scene = loaded(tmp_path)
    low, high = np.stack(pixels[1:8]).min(), np.stack(pixels[1:8]).max()
    margin = 0.01 * (high - low)
    assert scene.thermal_range.min_c == pytest.approx(low - margin)
    assert scene.thermal_range.max_c == pytest.approx(high + margin)
    assert scene.notes["encoding"] == "float pixels are temperatures in °C"
    celsius = scene.thermal_range.to_celsius(scene.train[0].thermal[..., 0])
    np.testing.assert_allclose(celsius, pixels[1], atol=1e-4)


def test_dji_names_are_times(tmp_path):
    files = [f"DJI_202408061734{40 + i:02d}_{i:04d}_T.png" for i in range(9)]
    write_colmap(tmp_path, files)
    scene = loaded(tmp_path)
    assert scene.train.times_s == [float(i) for i in range(7)]
    assert "DJI" in scene.notes["time_source"]


def test_times_by_pattern_and_by_table(tmp_path):
    write_colmap(tmp_path, names(9))
    by_name = loaded(tmp_path, time_regex=r"frame_(\d+)")
    assert by_name.train.times_s == [float(i) for i in range(7)]
    rows = [f"frame_{i:03d},2024-01-01T00:00:{2 * i:02d}" for i in range(9)]
    (tmp_path / "t.csv").write_text("\n".join(["name,utc", *rows]))
    by_table = loaded(tmp_path, time_csv="t.csv", time_csv_name="name", time_csv_time="utc")
    assert by_table.train.times_s == [2.0 * i for i in range(7)]
    assert by_table.notes["time_source"] == "t.csv, column utc"


def test_a_table_tells_images_of_one_name_apart_by_their_folders(tmp_path):
    files = [f"{camera}/{i}.png" for camera in ("left", "right") for i in range(5)]
    write_colmap(tmp_path, files)
    (tmp_path / "t.csv").write_text("\n".join(["file,time_s", *(f"{file},{i}" for i, file in enumerate(files))]))
    scene = loaded(tmp_path, time_csv="t.csv")
    times = {frame.name: frame.time_s for frame in (*scene.train.frames, *scene.test.frames)}
    assert [times[file] - times[files[0]] for file in files] == list(range(10))
    (tmp_path / "t.csv").write_text("\n".join(["file,time_s", "a/0.png,1", "b/0.png,2"]))
    with pytest.raises(
        SceneError, match="a/0.png and b/0.png have different times and may both be left/0.png; keep one"
    ):
        loaded(tmp_path, time_csv="t.csv")


def test_a_table_without_a_frame_names_it(tmp_path):
    write_colmap(tmp_path, names(9))
    (tmp_path / "t.csv").write_text("file,time_s\nframe_000.png,0\n")
    with pytest.raises(SceneError, match=r"t.csv has no row for frame_001.png \(8 of 9 images\)"):
        loaded(tmp_path, time_csv="t.csv")


def test_without_times_a_scene_is_static_and_says_so(tmp_path):
    scene = loaded(write_colmap(tmp_path, names(9)))
    assert "time" not in scene.metadata
    assert scene.notes["time_source"] == "none (set data.time_regex or data.time_csv)"
    assert scene.thermal_range is None and "no temperatures" in scene.notes["thermal_range_c"]


def test_a_prepared_folder_whose_frames_had_no_times_has_none(tmp_path):
    files = names(9)
    write_colmap(tmp_path, files)
    (tmp_path / "frames.csv").write_text("file,time,median\n" + "".join(f"{file},,20\n" for file in files))
    assert loaded(tmp_path).notes["time_source"].startswith("none")


def test_a_prepared_image_tells_how_uncertain_its_temperatures_are(tmp_path):
    write_colmap(tmp_path, names(9))
    assert "prepared_uncertainty_c" not in loaded(tmp_path).notes
    for beside, told in (("[1, 2]", None), ('{"uncertainty_c": {"camera": 1.0, "combined": 1.0164}}', 1.02)):
        (tmp_path / "images" / "frame_000.json").write_text(beside)
        assert loaded(tmp_path).notes.get("prepared_uncertainty_c") == told


def test_options_that_are_metadata(tmp_path):
    scene = loaded(write_colmap(tmp_path, names(9)), ambient_c=21.5, metres_per_unit=2.0)
    assert scene.ambient_c == 21.5 and scene.metres_per_unit == 2.0
    assert "axes" not in scene.notes
    (tmp_path / "world.json").write_text('{"metres_per_unit": 0.5, "axes": "east, north, up"}')
    assert loaded(tmp_path).notes["axes"] == "east, north, up"
    assert loaded(tmp_path).metres_per_unit == 0.5 and loaded(tmp_path, metres_per_unit=2.0).metres_per_unit == 2.0
    (tmp_path / "world.json").write_text('{"metres_per_unit": "far"}')
    with pytest.raises(SceneError, match="world.json: 'metres_per_unit'"):
        loaded(tmp_path)


def test_other_extensions_and_cases_are_found(tmp_path):
    write_colmap(tmp_path, names(9, "frame_{}.jpg"), images=None)
    for i in range(9):
        write_image(tmp_path / "images" / f"FRAME_{i}.png", grey(i))
    assert len(loaded(tmp_path).train) == 7


@pytest.mark.parametrize("keep", ["white", "black"])
@pytest.mark.parametrize("suffix", [".png", ""])
def test_masks_follow_colmap_s_rule(tmp_path, keep, suffix):
    write_colmap(tmp_path, names(9))
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[:10] = 255
    for name in names(9)[:4]:
        write_image(tmp_path / "masks" / f"{name}{suffix}", mask)
    scene = loaded(tmp_path, mask_keep=keep)
    expected = (mask > 0) if keep == "white" else (mask == 0)
    assert (scene.train[0].mask.numpy() == expected).all()
    assert scene.train[-1].mask is None
    assert scene.notes["masks"].startswith("4 of 9 images have a mask")


def test_masks_that_are_not_used_are_told(tmp_path, caplog):
    write_colmap(tmp_path, names(9))
    for i in range(9):
        write_image(tmp_path / "masks" / f"mask_{i:03d}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    assert loaded(tmp_path).train[0].mask is None
    assert "masks: none of its 9 files is named after an image, such as frame_000.png.png, and no mask" in caplog.text
    caplog.clear()
    assert loaded(tmp_path, masks=None).train[0].mask is None and not caplog.text
    with pytest.raises(SceneError, match="data.masks=mask: there is no folder .*/mask; data.masks=null uses no masks"):
        loaded(tmp_path, masks="mask")


def test_visible_images_of_other_names_are_refused(tmp_path):
    write_colmap(tmp_path, names(9))
    write_image(tmp_path / "rgb" / "photo_0.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    with pytest.raises(
        SceneError, match=r"data.rgb=rgb: no file in .*like 'photo_0.png', and images like 'frame_000.png'"
    ):
        loaded(tmp_path, rgb="rgb")


def test_visible_images_beside_the_thermal_ones(tmp_path):
    write_colmap(tmp_path, names(9))
    for i, name in enumerate(names(9)):
        write_image(tmp_path / "visible" / name, np.full((HEIGHT, WIDTH, 3), (i, 100, 200), np.uint8))
    view = loaded(tmp_path, rgb="visible").train[0]
    np.testing.assert_allclose(view.rgb[0, 0] * 255, [1, 100, 200], atol=1e-4)


def test_the_size_in_the_file_wins_over_the_size_in_the_model(tmp_path):
    camera = ("SIMPLE_PINHOLE", (100.0, 64.0, 48.0), 128, 96)
    write_colmap(tmp_path, names(9), camera=camera)
    view = loaded(tmp_path).train[0]
    np.testing.assert_allclose(view.camera.K.diagonal(), [100 * WIDTH / 128, 100 * HEIGHT / 96, 1])


def test_utm_models_are_recentred(tmp_path):
    write_colmap(tmp_path, names(9), center=(651234.0, 5683456.0, 30.0))
    scene = loaded(tmp_path)
    assert "recentred" in scene.notes
    assert scene.points.abs().max() < 20
    assert scene.extent == pytest.approx(loaded(write_colmap(tmp_path / "b", names(9))).extent, rel=1e-6)


# Bad input ------------------------------------------------------------------------------------------------------------


def test_no_root_asks_for_one():
    with pytest.raises(SceneError, match="data.root is not set"):
        Colmap().setup()


def test_a_root_that_does_not_exist_lists_what_is_near(tmp_path):
    (tmp_path / "other").mkdir()
    with pytest.raises(SceneError, match=r"there is no folder .*nowhere.*holds other/"):
        Colmap(root=str(tmp_path / "nowhere")).setup()


def test_a_missing_scene_lists_those_that_are_there(tmp_path):
    write_colmap(tmp_path / "one", names(9))
    write_colmap(tmp_path / "two", names(9))
    with pytest.raises(SceneError, match="data.scene=three: there is no such scene in .*one/, two/"):
        Colmap(root=str(tmp_path), scene="three").setup()
    with pytest.raises(SceneError, match="choose one with data.scene: one, two"):
        Colmap(root=str(tmp_path)).setup()


def test_no_sparse_model_says_what_was_looked_for(tmp_path):
    write_image(tmp_path / "s" / "images" / "a.png", grey(0))
    with pytest.raises(SceneError, match=r"a sparse model \(sparse/0\) is missing; .*holds images/"):
        Colmap(root=str(tmp_path), scene="s").setup()
    with pytest.raises(
        SceneError, match="it holds s/. Of a camera's files, prepare.py source=FOLDER target=OTHER makes"
    ):
        Colmap(root=str(tmp_path)).setup()
    (tmp_path / "report.html").write_text("")
    with pytest.raises(SceneError, match="A preparation left it without cameras: report.html"):
        Colmap(root=str(tmp_path)).setup()
    with pytest.raises(SceneError, match="no sparse model in .*Reconstruct the scene with COLMAP first"):
        read_model(tmp_path / "s")


def test_a_model_that_misses_a_file_names_it(tmp_path):
    folder = find_model(write_colmap(tmp_path, names(9)))
    (folder / "points3D.bin").write_bytes(b"")
    with pytest.raises(SceneError, match=r"points3D.bin is empty \(0 bytes\)"):
        read_model(tmp_path)
    (folder / "points3D.bin").unlink()
    with pytest.raises(SceneError, match="has no points3D.bin; copy the model or export"):
        read_model(tmp_path)


def test_a_text_model_of_known_cameras_may_have_an_empty_file_of_points(tmp_path):
    """As COLMAP's guide has them written: a line for each image, an empty one below it, and points3D.txt without content."""
    folder = find_model(write_colmap(tmp_path, names(9), text=True))
    lines = [line for line in (folder / "images.txt").read_text().splitlines() if line.rpartition(".")[2] == "png"]
    (folder / "images.txt").write_text("".join(f"{line}\n\n" for line in lines))
    (folder / "points3D.txt").write_text("")
    scene = loaded(tmp_path, random_points=50)
    assert len(scene.train) == 7 and len(scene.points) == 50
    assert "the sparse model has none" in str(scene.notes)
    (folder / "images.txt").write_text("".join(f"{line}\n3.5 4.5 -1 8.0 9.0 17\n" for line in lines))
    with pytest.raises(SceneError, match=r"points3D.txt is empty; copy the model"):  # its images know points
        read_model(tmp_path)


@pytest.mark.parametrize(
    "saved",
    [
        lambda text: text.rstrip("\n").encode(),  # editors take away empty lines at the end
        lambda text: (text.rstrip("\n") + "\n").encode(),
        lambda text: text.encode("utf-8-sig"),
        lambda text: text.encode("utf-16"),
        lambda text: text.replace("\n", "\r\n").encode(),
        lambda text: text.replace("\n", "\r").encode(),
    ],
    ids=["no end", "no last line of points", "mark", "utf-16", "windows", "carriage returns"],
)
def test_a_text_model_is_read_as_editors_save_it(tmp_path, saved):
    """COLMAP's own reader leaves the last image out where its line of points does not end."""
    folder = find_model(write_colmap(tmp_path, names(9), text=True))
    expected = read_model(tmp_path)
    for part in ("cameras", "images", "points3D"):
        file = folder / f"{part}.txt"
        lines = [line for line in file.read_text().splitlines() if not line.startswith("#")]
        if part == "images":
            lines = [line for one in lines[::2] for line in (one, "")]
        file.write_bytes(saved("\n".join([*lines, ""])))
    found = read_model(tmp_path)
    assert found.names == expected.names and found.folder == folder
    assert np.array_equal(found.viewmats, expected.viewmats) and np.array_equal(found.points, expected.points)
    assert found.point_ids == expected.point_ids


def test_a_damaged_model_is_named(tmp_path):
    folder = find_model(write_colmap(tmp_path, names(9)))
    (folder / "images.bin").write_bytes((folder / "images.bin").read_bytes()[:60])
    with pytest.raises(
        SceneError,
        match="images.bin is cut short or damaged: it announces 9 records, and its 60 bytes end before number 1 is",
    ):
        read_model(tmp_path)


def test_an_unknown_camera_model_is_named(tmp_path):
    folder = find_model(write_colmap(tmp_path, names(9), text=True))
    cameras = folder / "cameras.txt"
    cameras.write_text(cameras.read_text().replace("PINHOLE", "PERISCOPE"))
    with pytest.raises(SceneError, match="cameras.txt names a camera model that COLMAP does not know; supported are"):
        read_model(tmp_path)


def test_an_unsupported_camera_model_names_the_remedy(tmp_path):
    write_colmap(tmp_path, names(9), camera=("FOV", (40.0, 40.0, 20.0, 16.0, 0.1), WIDTH, HEIGHT))
    with pytest.raises(SceneError, match="camera 1: camera model FOV is not supported.*image_undistorter"):
        Colmap(root=str(tmp_path)).setup()


def test_damaged_images_are_named(tmp_path):
    write_colmap(tmp_path, names(9))
    path = tmp_path / "images" / names(9)[4]
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(SceneError, match="frame_004.png is corrupt"):
        Colmap(root=str(tmp_path)).setup()
    path.write_bytes(b"")
    with pytest.raises(SceneError, match=r"frame_004.png is empty \(0 bytes\)"):
        Colmap(root=str(tmp_path)).setup()


def test_too_few_points_are_refused(tmp_path):
    write_colmap(tmp_path, names(9), point_count=3)
    with pytest.raises(SceneError, match="has 3 finite points, at least 4"):
        Colmap(root=str(tmp_path)).setup()


@pytest.mark.parametrize(
    ("low", "high", "message"),
    [
        (40.0, 10.0, "temperature_bounds.json: the minimum 40.0 °C lies above the maximum 10.0 °C; swap"),
        (20.0, 20.0, "temperature_bounds.json: minimum and maximum are both 20.0 °C"),
        ("warm", 20.0, "temperature_bounds.json: 'absolute_min_temperature' is 'warm', a number"),
        (None, 20.0, "temperature_bounds.json has no key 'absolute_min_temperature'; it has absolute_max_temperature"),
    ],
)
def test_bad_bounds_are_refused(tmp_path, low, high, message):
    write_colmap(tmp_path, names(9))
    bounds = {"absolute_max_temperature": high}
    if low is not None:
        bounds["absolute_min_temperature"] = low
    write_json(tmp_path / "temperature_bounds.json", bounds)
    with pytest.raises(SceneError, match=message):
        Colmap(root=str(tmp_path)).setup()


def test_bounds_that_are_no_json_are_refused(tmp_path):
    write_colmap(tmp_path, names(9))
    (tmp_path / "temperature_bounds.json").write_text("10..40")
    with pytest.raises(SceneError, match="temperature_bounds.json is not readable JSON"):
        Colmap(root=str(tmp_path)).setup()


def test_bad_options_are_refused():
    with pytest.raises(SceneError, match=r"data.bounds_c needs two values \[min, max\] in °C, got \[1.0\]"):
        Colmap(bounds_c=[1.0])
    with pytest.raises(SceneError, match="data.radiometric must be one of auto, never"):
        Colmap(radiometric="yes")
    with pytest.raises(SceneError, match="data.mask_keep must be one of white, black"):
        Colmap(mask_keep="grey")
    with pytest.raises(SceneError, match="data.raw_scale must be positive"):
        Colmap(raw_scale=0.0)


# Real input -----------------------------------------------------------------------------------------------------------


@needs_m3t
def test_a_real_scene_loads_with_greys_and_with_counts():
    greys = loaded(M3T / "colmap_scene", downscale=2)
    counts = loaded(M3T / "colmap_scene", downscale=2, raw="raw16")
    assert len(greys.train) == 28 and len(greys.test) == 4 and len(greys.points) == 14455
    # 17:34:49 to 17:35:34 by the names; every 8th is test, the first one included
    assert greys.train.times_s[0] == 0 and max(greys.train.times_s) == 44.0 and greys.test.times_s[0] == -1.0
    assert greys.train[0].camera.K[0, 0] == 745.5 / 2
    assert "recentred" not in greys.notes
    for a, b in zip(greys.train, counts.train, strict=True):
        difference = (a.thermal - b.thermal).abs() * 255
        # The greys are the counts rounded to 8 bit (0.5), averaged and rounded again (0.5); a count is 0.13 of a grey.
        assert difference.max() < 1.07
        assert difference.mean() < 0.5


@needs_m3t
def test_real_times_from_the_table_agree_with_the_names():
    table = loaded(
        M3T / "colmap_scene",
        downscale=8,
        time_csv=str(M3T / "meta.csv"),
        time_csv_time="utc_at_exposure",
    )
    by_name = loaded(M3T / "colmap_scene", downscale=8)
    pairs = zip(table.train.frames, by_name.train.frames, strict=True)
    assert all(a.name == b.name and abs(a.time_s - b.time_s) < 2 for a, b in pairs)
    assert any(a.time_s % 1 for a in table.train.frames)


def test_pictures_are_no_counts(tmp_path):
    write_colmap(tmp_path, names(9))
    with pytest.raises(SceneError, match="data.raw: .*frame_000.png has 1 channels of uint8, counts are one channel"):
        Colmap(root=str(tmp_path), raw="images").setup()


@needs_m3t
def test_real_points_project_onto_the_images():
    scene = loaded(M3T / "colmap_scene")
    camera = scene.train[5].camera
    cam = camera.viewmat[:3, :3] @ scene.points.double().T + camera.viewmat[:3, 3:]
    pix = (camera.K @ cam)[:2] / cam[2]
    size = torch.tensor([[640.0], [512.0]])
    inside = ((pix > 0) & (pix < size)).all(0)
    assert (cam[2] > 0).all() and inside.float().mean() > 0.1


def test_a_table_of_places_is_found_however_excel_saved_it(tmp_path):
    write_colmap(tmp_path, names(9))
    table = tmp_path / "meta.csv"
    for encoding in ("utf-8-sig", "utf-16", "cp1252"):
        table.write_bytes("sep=;\r\nfile;Lat;Höhe\r\na.png;51,0;1\r\n".encode(encoding))
        assert loaded(tmp_path).positions == table
    table.write_bytes(b"\x81\x8d")
    assert loaded(tmp_path).positions is None


def test_pictures_of_radiometric_files_have_temperatures_by_the_palette_in_them(tmp_path):
    files = names(9, "frame_{:03d}.jpg")
    write_colmap(tmp_path, files, images=None)
    write_json(tmp_path / "temperature_bounds.json", BOUNDS)
    luma_red_blue = np.array([[16, 101, 140], [71, 179, 179], [126, 198, 96], [181, 173, 33], [235, 121, 130]])
    (tmp_path / "images").mkdir()
    for i, name in enumerate(files):
        shown = np.rint(named("iron").curve(256)[cv2.GaussianBlur(grey(i), (0, 0), 2)]).astype(np.uint8)
        data = flir_jpeg(raw_for(temperatures(i)), shown, palette=palette_record(luma_red_blue))
        (tmp_path / "images" / name).write_bytes(data)
    with pytest.raises(
        SceneError, match="data.palette=iron changes nothing for radiometric JPEGs such as frame_000.jpg"
    ):
        loaded(tmp_path, palette="iron")
    scene = loaded(tmp_path, palette="embedded", radiometric="never")
    assert "frame_000.jpg" in scene.notes["palette"] and scene.thermal_range.max_c == BOUNDS["absolute_max_temperature"]
    view = scene.train[0]
    known = torch.ones(HEIGHT, WIDTH, dtype=torch.bool) if view.mask is None else view.mask
    error = 255 * view.thermal[..., 0] - torch.from_numpy(cv2.GaussianBlur(grey(1), (0, 0), 2))
    assert known.float().mean() > 0.8 and error[known].abs().median() < 4
