"""The thermo layout: the yard written to disk and read back, its options, and NTR with weather."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from layouts import names, write_colmap
from scene_files import write_thermo

from heatsplat.contracts import SceneData, SceneError
from heatsplat.datamodules.ntr import NTR
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.film import SIZES, Recording, film
from heatsplat.datamodules.synthetic_scene.outdoor import OUTDOOR, OutdoorScene
from heatsplat.datamodules.synthetic_scene.outdoor_sky import START_UTC_S
from heatsplat.datamodules.thermo import Thermo

FRAMES = 9


@cache
def recording() -> Recording:
    return film(OutdoorScene(OUTDOOR["outdoor"]), replace(SIZES["tiny"], frames=FRAMES, points=120))


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("thermo") / "yard"
    write_thermo(recording(), folder)
    return folder


@pytest.fixture
def yard(written, tmp_path) -> Path:
    """A copy of the written scene that a test may damage."""
    return shutil.copytree(written, tmp_path / "yard")


def loaded(folder: Path, **options) -> SceneData:
    return Thermo(root=str(folder), **options).scene


def change(path: Path, edit) -> None:
    values = json.loads(path.read_text())
    edit(values)
    path.write_text(json.dumps(values))


def test_the_yard_survives_its_way_over_the_disk(written):
    scene, made = loaded(written), Synthetic(scene="outdoor", size="tiny", frames=FRAMES).scene
    assert scene.metadata == {"time", "thermal_range", "ambient", "metres", "weather", "labels"}
    assert (len(scene.train), len(scene.test)) == (len(made.train), len(made.test)) == (6, 3)
    assert scene.train.times_s == pytest.approx(made.train.times_s, abs=1e-3)
    assert scene.test.times_s == pytest.approx(made.test.times_s, abs=1e-3)
    assert scene.thermal_range == made.thermal_range and scene.metres_per_unit == 1.0
    for view, original in zip(scene.test, made.test, strict=True):
        assert (view.thermal - original.thermal).abs().max() <= 1 / 65535
        assert torch.allclose(view.camera.viewmat, original.camera.viewmat, atol=1e-9)
        assert view.frame.environment.air_c == pytest.approx(original.frame.environment.air_c, abs=1e-5)
    assert scene.notes["ambient_source"] == "mean air temperature of the record"
    assert scene.ambient_c == pytest.approx(made.weather.air_c.mean().item(), abs=0.01)
    nearest = torch.cdist(scene.points, torch.from_numpy(recording().points).float()).argmin(1)
    assert torch.equal(scene.labels, recording().scene.labels(torch.from_numpy(recording().points))[nearest])
    for name in ("times_s", "air_c", "wind_m_s", "irradiance_w_m2", "direct_w_m2", "diffuse_w_m2", "sun"):
        assert torch.allclose(getattr(scene.weather, name), getattr(made.weather, name), atol=2e-3), name
    assert scene.weather.notes["utc_at_zero_s"] == pytest.approx(START_UTC_S + recording().times_s[0], abs=1e-3)


def test_a_period_may_be_held_out_instead(yard):
    scene = loaded(yard, test_period=["2024-07-11T06:00:00Z", "2024-07-11T18:00:00+00:00"])
    zero = scene.weather.notes["utc_at_zero_s"]
    hours = [(zero + t - START_UTC_S) / 3600 for t in scene.test.times_s]
    assert len(hours) == 2 and min(hours) >= 6 and max(hours) <= 18
    assert len(scene.train) == FRAMES - 2
    with pytest.raises(SceneError, match="two moments .from, to. and split=json"):
        Thermo(root=str(yard), test_period=["2024-07-11T06:00:00Z"])
    with pytest.raises(SceneError, match="data.split=json leaves 9 training and 0 test frames"):
        loaded(yard, test_period=[0, 1])
    with pytest.raises(SceneError, match="data.test_period: '2024-07-11T06:00:00' has no time zone"):
        loaded(yard, test_period=["2024-07-11T06:00:00", "2024-07-12T06:00:00"])


def test_without_a_table_the_weather_is_that_of_the_frames(yard):
    (yard / "weather.csv").unlink()
    assert "weather" not in loaded(yard).metadata
    given = []

    def add(values):
        for frame in values["frames"]:
            given.append(len(given))
            frame["env"] = {"air_c": 10.0 + len(given), "wind_m_s": None, "pressure_hpa": 950.0}

    for subset in ("train", "test"):
        change(yard / f"transforms_{subset}.json", add)
    scene = loaded(yard, weather_max_gap_h=12.0)
    assert [f.environment.air_c for f in scene.train.frames] == pytest.approx([11, 12, 13, 14, 15, 16])
    assert scene.weather.wind_m_s is None and scene.weather.sun is not None
    with pytest.raises(SceneError, match="the weather of the single frames: air_c has no value for .* hours"):
        loaded(yard, weather_max_gap_h=1.0)
    change(yard / "transforms_test.json", lambda v: v["frames"][0]["env"].update(snow=1))
    with pytest.raises(SceneError, match="env has snow, which is none of air_c, wind_m_s"):
        loaded(yard)


def test_options_win_over_what_the_scene_says(yard):
    change(yard / "meta.json", lambda v: v.pop("metres_per_unit"))
    unknown = loaded(yard)
    assert unknown.metres_per_unit is None and "data.metres_per_unit" in unknown.notes["metres_per_unit"]
    scene = loaded(
        yard, min_c=-10.0, max_c=90.0, metres_per_unit=2.5, ambient_c=7.0, latitude=44.0, north=[1.0, 0.0, 0.0]
    )
    assert (scene.thermal_range.min_c, scene.thermal_range.max_c) == (-10.0, 90.0)
    assert (scene.metres_per_unit, scene.ambient_c) == (2.5, 7.0)
    assert scene.weather.notes["latitude"] == 44.0
    noon = int(scene.weather.sun[:, 2].argmax())
    assert scene.weather.sun[noon, 0] < -0.3  # in the south, which is -x now
    with pytest.raises(SceneError, match="W/m² of sunlight at .* below the horizon of -30, 9. Check the time zone"):
        loaded(yard, latitude=-30.0)
    with pytest.raises(SceneError, match="metres_per_unit of scene yard is -1"):
        loaded(yard, metres_per_unit=-1.0)


def test_without_a_place_there_is_no_sun(yard):
    change(yard / "meta.json", lambda v: v.pop("latitude"))
    weather = loaded(yard).weather
    assert weather.sun is None and weather.direct_w_m2 is None and weather.irradiance_w_m2 is not None
    assert "latitude and longitude are not known" in weather.notes["sun"]


def test_frames_outside_the_record_are_named(yard):
    lines = (yard / "weather.csv").read_text().splitlines()
    (yard / "weather.csv").write_text("\n".join(lines[:100]))
    with pytest.raises(SceneError, match=r"frame train/00.*png: there is no weather for second .* covers every frame"):
        loaded(yard)


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (np.zeros(7, dtype=np.int64), "data.labels: there are 7 rows for 120 points"),
        (np.zeros((120, 2), dtype=np.int64), r"labels.npy is \[120, 2\] or not finite; \[P\], a row per point"),
        (np.full(120, 0.5), "float64 values that are no classes"),
    ],
)
def test_labels_that_do_not_fit_are_refused(yard, labels, message):
    np.save(yard / "labels.npy", labels)
    with pytest.raises(SceneError, match=message):
        loaded(yard)


def test_features_are_read_and_must_fit(yard):
    np.save(yard / "space_features.npy", np.arange(240.0).reshape(120, 2))
    scene = loaded(yard)
    assert scene.point_features.shape == (120, 2) and scene.point_features.dtype == torch.float32
    assert scene.point_features[3].tolist() == [6.0, 7.0]
    np.save(yard / "space_features.npy", np.full((119, 2), 1.0))
    with pytest.raises(SceneError, match="data.point_features: there are 119 rows for 120 points"):
        loaded(yard)
    with pytest.raises(SceneError, match="data.features=mine.npy: there is no file"):
        loaded(yard, features="mine.npy")
    assert loaded(yard, features=None, labels=None).labels is None


def test_incomplete_scenes_are_named(yard):
    change(yard / "meta.json", lambda v: v.pop("max_value"))
    with pytest.raises(SceneError, match="meta.json has no key 'max_value'"):
        loaded(yard)
    (yard / "meta.json").unlink()
    with pytest.raises(
        SceneError, match="meta.json with transforms_train.json and transforms_test.json or sparse/0 is missing"
    ):
        loaded(yard)


def test_poses_may_come_from_colmap(tmp_path):
    """Times, weather and split of the frames then stand in meta.json."""
    write_colmap(tmp_path, names(6))
    frames = {
        Path(name).stem: {
            "utc": f"2024-07-11T{6 + 2 * i:02d}:00:00Z",
            "env": {"air_c": 10.0 + i},
            "split": "test" if i > 3 else "train",
        }
        for i, name in enumerate(names(6))
    }
    (tmp_path / "meta.json").write_text(json.dumps({"min_value": 0, "max_value": 50, "frames": frames}))
    scene = loaded(tmp_path)
    assert scene.train.times_s == [0.0, 7200.0, 14400.0, 21600.0] and scene.test.times_s == [28800.0, 36000.0]
    assert [f.environment.air_c for f in scene.test.frames] == [14.0, 15.0]
    assert scene.point_colors is not None and "weather" in scene.metadata


@pytest.mark.parametrize("text", [False, True])
def test_labels_and_features_are_those_of_the_points_in_their_file(tmp_path, text):
    """COLMAP's reader has points in an order of its own."""
    write_colmap(tmp_path, names(6), text=text, point_count=50)
    frames = {name: {"utc": 10 * i, "split": "test" if i > 3 else "train"} for i, name in enumerate(names(6))}
    (tmp_path / "meta.json").write_text(json.dumps({"min_value": 0, "max_value": 50, "frames": frames}))
    file = tmp_path / "sparse" / "0" / f"points3D.{'txt' if text else 'bin'}"
    if text:
        there = np.loadtxt(file, usecols=(1, 2, 3))
    else:
        kind = [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
        there = np.frombuffer(file.read_bytes()[8:], kind)["xyz"]
    np.save(tmp_path / "space_features.npy", there)
    np.save(tmp_path / "labels.npy", (there[:, 0] > 0).astype(int))
    scene = loaded(tmp_path)
    torch.testing.assert_close(scene.point_features, scene.points)
    assert torch.equal(scene.labels, (scene.points[:, 0] > 0).long())


@pytest.mark.parametrize("form", ["{}/{}.png", "{}/{}", "{1}.png", "{1}", "yard/{}/{}.tif"])
def test_frames_in_meta_may_be_named_with_and_without_folders_and_endings(yard, form):
    utc = {}

    def move(values):
        for frame in values["frames"]:
            utc[form.format(*Path(frame["file_path"]).parts)] = {"utc": frame.pop("utc")}

    before = loaded(yard)
    for subset in ("train", "test"):
        change(yard / f"transforms_{subset}.json", move)
    change(yard / "meta.json", lambda values: values.update(frames=utc))
    assert len(utc) == FRAMES and loaded(yard).test.times_s == before.test.times_s
    change(yard / "meta.json", lambda values: values.update(frames={"other.png": {"utc": 0}}))
    with pytest.raises(
        SceneError, match="meta.json: 'frames' names none of the scene's frames: other.png is not among"
    ):
        loaded(yard)


def test_ntr_takes_weather_classes_and_features_that_lie_beside_it(yard):
    """The same folder without UTC is an NTR scene whose frames count seconds."""
    times = dict(zip((f"{i:04d}" for i in range(FRAMES)), recording().times_s.tolist(), strict=True))

    def seconds(values):
        for frame in values["frames"]:
            frame.pop("utc")
            frame["time"] = times[frame["file_path"][-4:]]

    for subset in ("train", "test"):
        change(yard / f"transforms_{subset}.json", seconds)
    options = {"root": str(yard), "min_c": 0.0, "max_c": 70.0, "metres_per_unit": 1.0}
    with pytest.raises(SceneError, match="there is no weather for second"):
        _ = NTR(**options).scene  # the table is in UTC
    scene = NTR(**options, start_utc="2024-07-11T00:00:00Z", latitude=47.0, longitude=9.0).scene
    assert scene.metadata >= {"weather", "labels", "metres", "time"}
    assert scene.weather.sun is not None and scene.weather.notes["latitude"] == 47.0
    assert scene.test.times_s == pytest.approx(loaded_times(), abs=1e-3)
    bare = NTR(**options, weather=None, labels=None).scene
    assert "weather" not in bare.metadata and bare.test.times_s == pytest.approx(scene.test.times_s, abs=1e-6)


def loaded_times() -> list[float]:
    return (recording().times_s[6:] - recording().times_s[0]).tolist()
