import logging

import numpy as np
import pytest
from layouts import grey, names, rhd_names, write_colmap, write_image, write_rhd

from heatsplat.contracts import SceneError
from heatsplat.datamodules.rhd import RHD

INFO = {"T_env": 32.9, "min_value": 31, "max_value": 56}
SECONDS = [56304.825 + 10.25 * i for i in range(16)]


def loaded(root, **options):
    module = RHD(root=str(root), **options)
    module.setup()
    return module.scene


def test_the_published_layout(tmp_path):
    files = rhd_names(SECONDS)
    assert files[0] == "153824825.png"
    write_rhd(tmp_path, "cooling_bench", files, INFO)
    (tmp_path / "cooling_bench" / "rgb").mkdir()
    scene = loaded(tmp_path, scene="cooling_bench")
    assert scene.name == "cooling_bench"
    assert (scene.thermal_range.min_c, scene.thermal_range.max_c, scene.ambient_c) == (31, 56, 32.9)
    # quarters of 4 frames: the frame at (4 - 1) // 2 = 1 of each is test
    assert [f.name for f in scene.test.frames] == [files[i] for i in (1, 5, 9, 13)]
    expected = [10.25 * i for i in range(16) if i % 4 != 1]
    np.testing.assert_allclose(scene.train.times_s, expected, atol=1e-9)
    np.testing.assert_allclose(scene.train[1].thermal[..., 0] * 255, grey(2), atol=1e-4)
    assert "cameras of their own" in scene.notes["rgb"]
    assert {"time", "thermal_range", "ambient"} <= scene.metadata


@pytest.mark.parametrize("place", ["scene", "thermal"])
def test_the_root_may_be_the_scene_or_its_thermal_folder(tmp_path, place):
    write_rhd(tmp_path, "bottles", rhd_names(SECONDS), INFO)
    root = tmp_path / "bottles" if place == "scene" else tmp_path / "bottles" / "thermal"
    assert loaded(root).name == "bottles"
    assert loaded(tmp_path, scene="bottles/thermal").name == "bottles"


@pytest.mark.parametrize(
    ("split", "test"),
    [("every_8th", [0, 8]), ("block", [7, 8]), ("quarter_centre", [1, 5, 9, 13])],
)
def test_other_splits_are_options(tmp_path, split, test):
    files = rhd_names(SECONDS)
    write_rhd(tmp_path, "s", files, INFO)
    scene = loaded(tmp_path, scene="s", split=split)
    assert [f.name for f in scene.test.frames] == [files[i] for i in test]
    assert scene.notes["split"] == split


def test_a_recording_over_midnight_keeps_its_order_and_span(tmp_path):
    files = rhd_names([86400 - 75 + 10 * i for i in range(16)])
    assert files[0].startswith("2358") and files[-1].startswith("0001")
    write_rhd(tmp_path, "s", files, INFO)
    scene = loaded(tmp_path, scene="s")
    assert scene.notes["duration_s"] == pytest.approx(150)
    assert scene.train.frames[0].name == files[0]
    assert scene.train.times_s == sorted(scene.train.times_s)
    assert "24 h were added" in scene.notes["midnight"]


def test_times_belong_to_names_not_to_ranks(tmp_path):
    """An image that is not registered must not shift the times of the others."""
    files = rhd_names(SECONDS)
    write_rhd(tmp_path, "s", files, INFO)
    write_image(tmp_path / "s" / "thermal" / "images" / rhd_names([SECONDS[3] + 5])[0], grey(0))
    scene = loaded(tmp_path, scene="s")
    by_name = {f.name: f.time_s for f in scene.train.frames}
    assert by_name[files[15]] == pytest.approx(10.25 * 15)
    assert scene.notes["images_unregistered"].startswith("1 file ")


@pytest.mark.parametrize("form", ["color_{}", "color_{}_x", "pre_{}", "{}"])
def test_names_of_older_copies_are_matched(tmp_path, form):
    files = rhd_names(SECONDS)
    in_model = [form.format(f[:-4]) + ".png" for f in files]
    folder = tmp_path / "s" / "thermal"
    write_colmap(folder, in_model, images=None)
    for i, f in enumerate(files):
        write_image(folder / "images" / (f"red_{f}" if form == "color_{}" else f), grey(i))
    scene = loaded(tmp_path, scene="s")
    assert len(scene.train) == 12 and scene.train.times_s[1] == pytest.approx(20.5)
    np.testing.assert_allclose(scene.train[1].thermal[..., 0] * 255, grey(2), atol=1e-4)


def test_more_than_nine_digits_in_a_row_are_no_time_and_match_no_names(tmp_path, caplog):
    files = [
        f"20240806153{i:03d}123.png" for i in range(9)
    ]  # a date and a time, of which the first nine digits are all the same
    write_rhd(tmp_path, "s", files, INFO)
    assert set(loaded(tmp_path, scene="s").train.times_s) == {None} and "20240806153000123" in caplog.text
    write_colmap(tmp_path / "t" / "thermal", [f"photo-{file}" for file in files], images=None)
    write_image(tmp_path / "t" / "thermal" / "images" / files[0], grey(0))
    with pytest.raises(SceneError, match="none of the 9 images of the sparse model"):
        loaded(tmp_path, scene="t")


def test_without_info_the_defaults_are_loud(tmp_path, caplog):
    write_rhd(tmp_path, "s", rhd_names(SECONDS))
    with caplog.at_level(logging.WARNING):
        scene = loaded(tmp_path, scene="s")
    assert (scene.thermal_range.min_c, scene.thermal_range.max_c, scene.ambient_c) == (21, 31, 26)
    assert "does not give T_env, min_value, max_value" in scene.notes["bounds_assumed"]
    assert "ETGS's defaults are assumed" in caplog.text


def test_a_part_of_info_is_used(tmp_path):
    write_rhd(tmp_path, "s", rhd_names(SECONDS), {"T_env": 20.0, "max_value": 90})
    scene = loaded(tmp_path, scene="s")
    assert (scene.thermal_range.min_c, scene.thermal_range.max_c, scene.ambient_c) == (15, 90, 20)
    assert "does not give min_value;" in scene.notes["bounds_assumed"]


@pytest.mark.parametrize(
    ("info", "message"),
    [
        (
            {"T_env": 26, "min_value": 50, "max_value": 20},
            "info.json: the minimum 50.0 °C lies above the maximum 20.0 °C",
        ),
        ({"T_env": 26, "min_value": 20, "max_value": 20}, "info.json: minimum and maximum are both 20.0 °C"),
        ({"T_env": "?"}, "info.json: 'T_env' is '\\?', a number in °C is needed"),
    ],
)
def test_bad_info_is_refused(tmp_path, info, message):
    write_rhd(tmp_path, "s", rhd_names(SECONDS), info)
    with pytest.raises(SceneError, match=message):
        loaded(tmp_path, scene="s")


def test_names_without_times_leave_the_scene_without_times(tmp_path):
    write_rhd(tmp_path, "s", names(16), INFO)
    scene = loaded(tmp_path, scene="s")
    assert "time" not in scene.metadata
    assert "file names are not HHMMSSmmm" in scene.notes["time_source"]


def test_the_colour_folder_is_not_taken_for_temperatures(tmp_path):
    import cv2

    pixels = [np.ascontiguousarray(cv2.applyColorMap(grey(i), cv2.COLORMAP_JET)) for i in range(16)]
    write_rhd(tmp_path, "s", rhd_names(SECONDS), INFO, pixels=pixels)
    with pytest.raises(SceneError, match="is pseudo-colour"):
        loaded(tmp_path, scene="s")


def test_no_model_lists_what_is_there(tmp_path):
    write_image(tmp_path / "s" / "thermal" / "images" / "000000000.png", grey(0))
    with pytest.raises(SceneError, match=r"a sparse model \(thermal/sparse/0\) is missing; .*holds thermal/"):
        loaded(tmp_path, scene="s")
    with pytest.raises(SceneError, match="data.scene=x: there is no such scene in .*holds s/"):
        loaded(tmp_path, scene="x")
