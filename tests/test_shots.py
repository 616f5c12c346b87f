"""The files of a shot: what was not seen is no temperature, what lies beyond the record is a prediction."""

import csv
import logging
import re
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from weathered import CAMERA, make_scene

from heatsplat.contracts import Frame, SceneError, View, ViewSet
from heatsplat.io.tiff import read_temperature, write_temperature
from heatsplat.shots import (
    ShotFiles,
    checked_unseen,
    depth_beside,
    deviations_told,
    file_stems,
    seconds_in,
    shot_frames,
    sightings,
    warn_beyond_record,
    write_shot,
)


def test_deviations_leave_out_what_the_camera_is_off_by():
    scene = SimpleNamespace(notes={})
    assert deviations_told(scene) == "1σ"
    scene.notes["prepared_uncertainty_c"] = 1.02
    assert deviations_told(scene) == "1σ, without the camera's own error (±1.0 °C, prepare)"


def test_unseen_pixels_are_nan_in_tiff_and_counted(tmp_path, caplog):
    scene = make_scene()
    frames = shot_frames(scene, "view", 0.0, 0, 1)
    height, width = frames[0].camera.height, frames[0].camera.width
    seen = torch.ones(height, width, dtype=torch.bool)
    seen[0] = False
    with caplog.at_level(logging.WARNING, "heatsplat"):
        write_shot(
            [({"recorded": torch.full((height, width, 1), 0.5)}, seen)], frames, scene, ShotFiles(tmp_path, video=False)
        )
    values = read_temperature(next(tmp_path.glob("tiff/*.tiff")))
    assert np.isnan(values[0]).all()
    assert np.allclose(values[1:], scene.thermal_range.to_celsius(0.5))
    (row,) = csv.DictReader((tmp_path / "frames.csv").open())
    assert float(row["seen_share"]) == pytest.approx(1 - 1 / height, abs=1e-4)
    assert "no training view has seen" in caplog.text


def test_moments_may_be_dates_of_the_clock_that_the_scene_has():
    """2024-08-07 09:00 UTC is second 0; the weather's clock is in UTC, and a camera's own has no zone that is known."""
    noon = 1723021200.0
    weather = make_scene()
    weather = replace(weather, weather=replace(weather.weather, notes={"utc_at_zero_s": noon}))
    camera = replace(weather, weather=None, notes={"clock_at_zero_s": noon})
    for scene in (weather, camera):
        assert seconds_in(scene, "2024-08-07T09:00") == [0.0] and seconds_in(scene, 7) == [7]
        assert seconds_in(scene, ["2024-08-07 09:00:30.5", 60.0]) == [30.5, 60.0]
        frames = shot_frames(scene, "view", ["2024-08-07T09:00", "2024-08-07T09:00:10"], 0, 3)
        assert [frame.time_s for frame in frames] == [0, 5, 10]
    assert seconds_in(weather, "2024-08-07T11:00:05+02:00") == [5.0]
    with pytest.raises(SceneError, match="time=2024-08-07T11:00:00.02:00: nothing tells the time zone"):
        seconds_in(camera, "2024-08-07T11:00+02:00")
    with pytest.raises(SceneError, match="nothing tells which date .* give seconds since the first"):
        seconds_in(replace(camera, notes={}), "2024-08-07T11:00")
    with pytest.raises(SceneError, match="time must be a number of seconds or a date-time such as .* got noon"):
        shot_frames(camera, "view", "noon", 0, 1)


def test_without_coverage_every_pixel_is_written(tmp_path, caplog):
    scene = make_scene()
    frames = shot_frames(scene, "view", 0.0, 0, 1)
    camera = frames[0].camera
    with caplog.at_level(logging.WARNING, "heatsplat"):
        images = {"recorded": torch.full((camera.height, camera.width, 1), 0.5)}
        write_shot([(images, None)], frames, scene, ShotFiles(tmp_path, video=False))
    assert np.isfinite(read_temperature(next(tmp_path.glob("tiff/*.tiff")))).all()
    assert "no training view" not in caplog.text


def test_frames_of_an_earlier_shot_in_the_same_folder_are_told(tmp_path, caplog):
    """Three frames, then two of another moment: the third would pass for one of them."""
    scene = make_scene()
    for count, told in ((3, ""), (3, ""), (2, "2 files in .* left of an earlier command, such as png/0_0002.png")):
        frames = shot_frames(scene, "view", [0.0, 10.0], 0, count)
        image = {"recorded": torch.full((frames[0].camera.height, frames[0].camera.width, 1), 0.5)}
        with caplog.at_level(logging.WARNING, "heatsplat"):
            write_shot([(image, None)] * count, frames, scene, ShotFiles(tmp_path, video=False))
        assert re.search(told, caplog.text) if told else "earlier command" not in caplog.text
    assert (tmp_path / "tiff" / "0_0002.tiff").exists()  # which may be wanted


def test_every_image_of_a_frame_has_files_of_its_own_and_one_range(tmp_path):
    scene = make_scene()
    frames = shot_frames(scene, "view", [0.0, 10.0], 0, 2)
    camera = frames[0].camera
    size = camera.height, camera.width
    shown = [
        {
            "recorded": torch.full((*size, 1), 0.5),
            "clean": torch.full((*size, 1), 0.4 + i / 10),
            "rgb": torch.ones(*size, 3),
        }
        for i in range(2)
    ]
    images = zip(shown, (None, None), strict=True)
    written = write_shot(images, frames, scene, ShotFiles(tmp_path, codec="mpeg4", figures="svg"))
    names = sorted({path.relative_to(tmp_path).parts[0] for path in written})
    films = ["video.mp4", "video_clean.mp4", "video_rgb.mp4"]
    assert names == ["figures", "frames.csv", "png", "png_clean", "png_rgb", "tiff", "tiff_clean", *films]
    assert all(path.stat().st_size for path in written)
    clean = [read_temperature(path) for path in sorted(tmp_path.glob("tiff_clean/*"))]
    assert np.allclose(clean[1] - clean[0], scene.thermal_range.span_k / 10, atol=1e-4)
    one, other = (cv2.imread(str(tmp_path / f"{kind}/0_0001.png")) for kind in ("png", "png_clean"))
    assert (one[60:] == other[60:]).all()  # 0.5 has one colour in both; the titles differ
    first, second = (cv2.imread(str(tmp_path / f"png_clean/0_000{i}.png")) for i in range(2))
    assert not (first[60:] == second[60:]).all()


def test_a_film_of_cameras_with_images_of_several_sizes_has_the_size_of_its_first(tmp_path):
    scene = make_scene()
    first = scene.train.frames[0]
    sizes = [(48, 40), (96, 30), (20, 100)]
    frames = [replace(first, name=f"{w}x{h}.png", camera=first.camera.resized(w, h)) for w, h in sizes]
    images = [({"recorded": torch.full((h, w, 1), 0.5)}, None) for w, h in sizes]
    write_shot(images, frames, scene, ShotFiles(tmp_path, codec="mpeg4"))
    film, shapes = cv2.VideoCapture(str(tmp_path / "video.mp4")), []
    while (read := film.read())[0]:
        shapes.append(read[1].shape)
    assert shapes == [cv2.imread(str(tmp_path / "png" / "48x40.png")).shape] * 3


def test_a_still_shows_the_moment_of_its_view_and_a_film_the_record():
    scene = make_scene()
    taken = scene.train.frames[1]
    (still,) = shot_frames(scene, "view", None, 1, 1)
    assert still.time_s == taken.time_s == 7200.0
    film = shot_frames(scene, "view", None, 1, 3)
    assert [film[0].time_s, film[-1].time_s] == [min(scene.train.times_s), max(scene.train.times_s)]
    assert [frame.name for frame in film] == [taken.name.replace(".", f"_000{i}.") for i in range(3)]
    assert shot_frames(scene, "view", 5.0, 1, 1)[0].time_s == 5.0


def test_given_cameras_are_seen_at_their_own_times_or_at_those_that_are_asked_for():
    scene = make_scene()
    first, second = scene.train.frames[:2]
    cameras = [Frame("a.png", 0, first.camera, 3600.0), Frame("b.png", 1, second.camera.resized(20, 10))]
    shot = shot_frames(scene, "cameras", cameras=cameras)
    assert [frame.time_s for frame in shot] == [3600.0, scene.middle_s]
    assert [frame.name for frame in shot] == ["a.png", "b.png"] and shot[1].camera is cameras[1].camera
    assert not {frame.frame_id for frame in shot} & {frame.frame_id for frame in scene.frames}
    assert shot[0].environment == scene.weather.at(3600.0)
    assert [frame.time_s for frame in shot_frames(scene, "cameras", [0.0, 60.0], cameras=cameras)] == [0.0, 60.0]


def test_a_path_leads_through_given_cameras_and_their_times():
    scene = make_scene()
    first, second = (frame.camera for frame in scene.train.frames[:2])
    cameras = [Frame("a.png", 0, first, 600.0), Frame("b.png", 1, second, 0.0)]
    path = shot_frames(scene, "path", count=3, cameras=cameras)
    assert [frame.time_s for frame in path] == [600.0, 300.0, 0.0]
    assert torch.allclose(path[0].camera.viewmat, first.viewmat) and torch.allclose(
        path[2].camera.viewmat, second.viewmat
    )
    timeless = [replace(frame, time_s=None) for frame in cameras]
    assert {frame.time_s for frame in shot_frames(scene, "path", count=3, cameras=timeless)} == {scene.middle_s}


@pytest.mark.parametrize(("metres_per_unit", "scale", "unit"), [(None, 1.0, "units"), (20.0, 20.0, "m")])
def test_depth_is_in_metres_where_the_scene_has_a_scale_and_nan_where_there_is_no_surface(
    tmp_path, metres_per_unit, scale, unit
):
    scene = make_scene()
    frames = shot_frames(scene, "view", 0.0, 0, 1)
    height, width = frames[0].camera.height, frames[0].camera.width
    depth = torch.full((height, width), 3.0)
    depth[0] = torch.inf
    beside = depth_beside(scene, lambda frame: depth, frames, metres_per_unit)
    _, z = frames[0].camera.project(scene.points)
    assert beside.bar.low < scale * z.median() < beside.bar.high < 2 * scale * z.max() and beside.bar.unit == unit
    images = [({"recorded": torch.full((height, width, 1), 0.5)}, torch.zeros(height, width, dtype=torch.bool))]
    write_shot(images, frames, scene, ShotFiles(tmp_path, video=False), beside=[beside])
    (path,) = tmp_path.glob("tiff_depth/*.tiff")
    found = read_temperature(path)
    assert np.isnan(found[0]).all() and (found[1:] == 3.0 * scale).all()  # also of what no training view has seen
    assert [*tmp_path.glob("png_depth/*.png")]


def test_depth_has_ends_of_colours_where_no_point_is_in_sight(tmp_path):
    scene = make_scene()
    (frame,) = shot_frames(scene, "view", 0.0, 0, 1)
    viewmat = torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0], dtype=torch.float64)) @ frame.camera.viewmat
    away = replace(frame, camera=replace(frame.camera, viewmat=viewmat))
    bar = depth_beside(scene, lambda frame: torch.ones(2, 2), [away], None).bar
    assert 0 < bar.low < scene.distance < bar.high


def test_pictures_have_the_colours_that_were_asked_for(tmp_path):
    scene = make_scene()
    (frame,) = shot_frames(scene, "view", 0.0, 0, 1)
    image = torch.linspace(0.0, 1.0, frame.camera.width).expand(frame.camera.height, -1)[..., None]
    shown = {}
    for name in ("inferno", "gray"):
        files = ShotFiles(tmp_path / name, video=False)
        write_shot([({"recorded": image}, None)], [frame], scene, files, colormap=name)
        (path,) = (tmp_path / name / "png").glob("*.png")
        shown[name] = cv2.imread(str(path)).astype(int)
    assert np.ptp(shown["gray"], axis=2).max() == 0 and np.ptp(shown["inferno"], axis=2).max() > 50


def test_isotherms_and_contours_are_drawn_into_temperatures_alone(tmp_path, monkeypatch):
    scene = make_scene()
    (frame,) = shot_frames(scene, "view", 0.0, 0, 1)
    image = torch.linspace(0.0, 1.0, frame.camera.width).expand(frame.camera.height, -1)[..., None]
    shown = []
    monkeypatch.setattr(
        "heatsplat.shots.compose", lambda panels, title: shown.extend(panels) or np.zeros((4, 4, 3), np.uint8)
    )
    beside = depth_beside(scene, lambda frame: torch.ones(frame.camera.height, frame.camera.width), [frame], None)
    images = [({"recorded": image, "rgb": image.expand(-1, -1, 3)}, None)]
    middle = scene.thermal_range.to_celsius(0.5)
    look = {"isotherm": (middle, np.inf), "contours": [middle]}
    write_shot(images, [frame], scene, ShotFiles(tmp_path, video=False), beside=[beside], **look)
    temperature, colour, depth = shown
    assert "green: 50.0 % above" in temperature.title and [level for level, _ in temperature.lines] == [middle]
    assert colour.title == "rgb" and "green" not in depth.title and not colour.lines and not depth.lines
    with pytest.raises(SceneError, match="contours=1e-09 draws more than 50 lines"):
        write_shot(iter(()), [frame], scene, ShotFiles(tmp_path / "b"), contours=1e-9)


def test_a_figure_names_the_view_its_moment_and_the_clock(tmp_path):
    scene = make_scene()
    weather = replace(scene.weather, notes={"utc_at_zero_s": 1722965689.0})
    scene = replace(scene, weather=weather)
    frames = shot_frames(scene, "view", 3600.0, 0, 1)
    camera = frames[0].camera
    images = [({"recorded": torch.full((camera.height, camera.width, 1), 0.5)}, None)]
    files, titles = ShotFiles(tmp_path, video=False, figures="svg"), {"recorded": "render"}
    write_shot(images, frames, scene, files, range_c=[-5.0, 5.0], titles=titles)
    (figure,) = tmp_path.glob("figures/*.svg")
    svg = figure.read_text()
    assert "60.0 min (2024-08-06 18:34 UTC)   0_0000" in svg
    assert "render · 100 % above 5 °C" in svg


def test_pictures_of_greys_without_temperatures_say_so_at_their_bar(tmp_path, monkeypatch):
    scene = replace(make_scene(), thermal_range=None)
    frames = shot_frames(scene, "view", None, 0, 1)
    image = torch.full((frames[0].camera.height, frames[0].camera.width, 1), 0.5)
    shown = []
    monkeypatch.setattr(ShotFiles, "add_picture", lambda self, suffix, stem, panel, *_, **__: shown.append(panel))
    for ends in (None, [10.0, 40.0]):
        write_shot([({"recorded": image}, None)], frames, scene, ShotFiles(tmp_path, video=False), range_c=ends)
    assert [panel.bar.unit for panel in shown] == ["image value"] * 2
    assert shown[1].title.endswith("100 % below 10 image value")


def test_the_time_stands_before_a_name_that_narrow_pictures_cut(tmp_path, monkeypatch):
    scene = make_scene()
    (frame,) = shot_frames(scene, "view", scene.train.times_s[0], 0, 1)
    titles: list[str] = []
    monkeypatch.setattr(ShotFiles, "add_picture", lambda self, suffix, stem, panel, title, **_: titles.append(title))
    size = frame.camera.height, frame.camera.width
    images = [({"recorded": torch.full((*size, 1), 0.5)}, None)]
    write_shot(images, [frame], scene, ShotFiles(tmp_path, video=False))
    (told,) = titles
    assert re.fullmatch(rf"-?\d+\.\d s.*   {frame.name.partition('.')[0]}\S*", told)


def test_limits_stand_before_the_title_which_narrow_panels_cut(tmp_path, monkeypatch):
    scene = make_scene()
    frames = shot_frames(scene, "view", scene.train.times_s[-1] + 3600.0, 0, 1)
    size = frames[0].camera.height, frames[0].camera.width
    seen = torch.arange(size[0] * size[1]).reshape(size) % 4 > 0
    shown = []
    monkeypatch.setattr(ShotFiles, "add_picture", lambda self, suffix, stem, panel, *_, **__: shown.append(panel.title))
    images = [({"recorded": torch.full((*size, 1), 0.5)}, seen)]
    write_shot(images, frames, scene, ShotFiles(tmp_path, video=False), titles={"recorded": "render"})
    assert re.fullmatch(r"prediction, .* beyond the record · 75 % seen · render", shown[0])


def test_moments_beyond_the_record_are_told_apart():
    scene = make_scene()
    first, last = min(scene.train.times_s), max(scene.train.times_s)
    assert scene.beyond_record((first + last) / 2) == 0
    assert scene.beyond_record(last + 60) == pytest.approx(60)
    assert scene.beyond_record(first - 60) == pytest.approx(60)
    assert scene.beyond_record(None) == 0


def test_a_shot_beyond_the_record_is_warned_of_once(caplog):
    scene = make_scene()
    last = max(scene.train.times_s)
    with caplog.at_level(logging.WARNING, "heatsplat"):
        assert not warn_beyond_record(scene, shot_frames(scene, "view", last, 0, 2), "nothing")
        assert not caplog.records
        assert warn_beyond_record(scene, shot_frames(scene, "view", [last, last + 20.0], 0, 3), "sources are off")
    (record,) = caplog.records
    for part in ("2 of 3", f"{last + 10:.6g} to {last + 20:.6g} s", f"to {last:.6g} s", "sources are off"):
        assert part in record.getMessage()


def test_every_training_view_is_a_sighting_on_a_coarse_grid():
    scene = make_scene()
    frames = [replace(frame, camera=CAMERA.resized(400, 200)) for frame in scene.train.frames]
    mask = torch.zeros(200, 400, dtype=torch.bool)
    mask[:, 200:] = True
    scene = replace(scene, train=ViewSet(frames, lambda index: View(frames[index], mask=mask)))
    asked = []

    def depth_of(frame):
        asked.append(frame)
        return torch.ones(frame.camera.height, frame.camera.width)

    found = sightings(scene, depth_of)
    assert len(found) == len(scene.train)
    assert all((one.camera.width, one.camera.height) == (192, 96) for one in found)
    assert all(not one.mask[:, :96].any() and one.mask[:, 96:].all() for one in found)
    assert [frame.time_s for frame in asked] == list(scene.train.times_s)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"trajectory": "circle"}, "trajectory must be one of orbit, path, test, train, view, cameras, got 'circle'"),
        ({"time": "abc"}, "time must be a number of seconds or a date-time such as .* got abc"),
        ({"time": float("nan")}, "time must be a number, got nan"),
        ({"time": []}, "time must be a number of seconds"),
        ({"time": [0, 1, 2]}, r"time must be one moment or \[start, end\], got \[0, 1, 2\]"),
        ({"view": "--5"}, "view '--5' is no training frame; there are 0.png"),
        ({"view": "²"}, "view '²' is no training frame; there are 0.png"),
        ({"view": 1.9}, "view must be the whole number or the file name of a training frame, got 1.9"),
        ({"count": 1.5}, "frames must be a whole number, 1 or more, got 1.5"),
        ({"count": 0}, "frames must be a whole number, 1 or more, got 0"),
    ],
)
def test_a_setting_that_makes_no_shot_is_named(settings, told):
    with pytest.raises(SceneError, match=told):
        shot_frames(make_scene(), **{"trajectory": "view", **settings})


def test_views_of_which_the_scene_has_none_are_no_shot():
    scene = make_scene()
    scene = replace(scene, test=scene.test.subset([]))
    with pytest.raises(SceneError, match="trajectory=test: scene 'yard' has no such views; give another trajectory"):
        shot_frames(scene, "test")


def test_moving_cameras_and_a_view_have_finer_pixels_where_training_rendered_them():
    scene = make_scene()
    for trajectory in ("view", "path"):
        (taken,), (finer,) = (shot_frames(scene, trajectory, 0.0, 0, 1, finer=finer) for finer in (1, 4))
        assert (finer.camera.width, finer.camera.height) == (4 * taken.camera.width, 4 * taken.camera.height)
        assert torch.equal(finer.camera.K[:2], 4 * taken.camera.K[:2])
        assert torch.equal(finer.camera.viewmat, taken.camera.viewmat)
    for trajectory in ("train", "test"):
        frames = getattr(scene, trajectory).frames
        assert [f.camera for f in shot_frames(scene, trajectory, finer=4)] == [f.camera for f in frames]


def test_a_camera_that_stands_still_has_no_orbit_but_a_path():
    scene = make_scene()
    with pytest.raises(SceneError, match="give no orbit; choose trajectory=path or view instead"):
        shot_frames(scene)
    assert len(shot_frames(scene, "path", count=2)) == 2


def test_an_unquoted_nan_is_the_word():
    """As Hydra reads unseen=nan."""
    assert [checked_unseen("unseen", given) for given in (float("nan"), "nan", "keep")] == ["nan", "nan", "keep"]
    with pytest.raises(SceneError, match="unseen must be one of nan, keep, got 'show'"):
        checked_unseen("unseen", "show")


def two_cameras():
    """A scene whose training images are called alike in two folders."""
    scene = make_scene()
    first = scene.train.frames[0]
    moved = replace(
        first.camera, viewmat=first.camera.viewmat + torch.eye(4, dtype=first.camera.viewmat.dtype)[[3, 0, 1, 2]]
    )
    frames = [
        replace(first, name="left/1.png"),
        replace(first, name="right/1.png", camera=moved),
        replace(first, name="right/2.png"),
    ]
    return replace(scene, train=ViewSet(frames, lambda i: View(frames[i], torch.zeros(4, 4, 1))))


def test_a_view_is_named_with_its_folder_where_the_name_alone_is_not_enough():
    scene = two_cameras()
    (frame,) = shot_frames(scene, "view", 0.0, "right/1.png", 1)
    assert torch.equal(frame.camera.viewmat, scene.train.frames[1].camera.viewmat)
    assert torch.equal(
        shot_frames(scene, "view", 0.0, "2.png", 1)[0].camera.viewmat, scene.train.frames[2].camera.viewmat
    )
    with pytest.raises(SceneError, match="view '1.png' may be left/1.png, right/1.png: name it with its folder"):
        shot_frames(scene, "view", 0.0, "1.png", 1)


@pytest.mark.parametrize(
    ("names", "stems"),
    [
        (["left/1.png", "right/2.png"], ["1", "2"]),
        (["left/1.png", "right/1.png"], ["left_1", "right_1"]),
        (["17.34.49", "17.34.50"], ["17.34.49", "17.34.50"]),  # names without an ending
        (["1.png", "1.jpg"], ["1.png", "1.jpg"]),
        (["a_b/c.png", "a/b/c.png", "d.png"], ["a_b_c.png_0", "a_b_c.png_1", "d.png_2"]),
    ],
)
def test_files_of_no_two_frames_have_one_name(names, stems):
    assert list(file_stems(names).items()) == list(zip(names, stems, strict=True))


def test_files_of_long_names_have_names_that_file_systems_take(tmp_path):
    long = "雪" * 80
    names = [f"{long}{i}.png" for i in range(2)] + [f"{folder}/{long}.png" for folder in "ab"]
    for some in (names[:2], names):
        stems = {*file_stems(some).values()}
        assert len(stems) == len(some)
        for stem in stems:
            write_temperature(tmp_path / f"{stem}_uncertainty_0001.tiff", torch.zeros(2, 2))


def test_images_of_one_name_have_files_of_their_own(tmp_path):
    scene = two_cameras()
    frames = scene.train.frames
    camera = frames[0].camera
    images = [({"recorded": torch.full((camera.height, camera.width, 1), 0.1 * i)}, None) for i in range(3)]
    write_shot(images, frames, scene, ShotFiles(tmp_path, video=False))
    assert sorted(path.stem for path in (tmp_path / "tiff").iterdir()) == ["left_1", "right_1", "right_2"]
    assert np.allclose(
        read_temperature(tmp_path / "tiff" / "right_1.tiff"), scene.thermal_range.to_celsius(0.1), atol=1e-4
    )
    assert [row["frame"] for row in csv.DictReader((tmp_path / "frames.csv").open())] == [
        "left_1",
        "right_1",
        "right_2",
    ]
