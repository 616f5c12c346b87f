"""The doctor on folders: a scene that trains, and a camera's files."""

import functools
import json
import shutil
from dataclasses import replace
from datetime import timedelta

import numpy as np
import pytest
import scene_files
from PIL import Image
from recordings import read_frames

from benchmarks.camera_folder import Field, write_camera
from heatsplat.contracts import SceneError
from heatsplat.datamodules.benchmark_folder import write_scene
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.film import SIZES, Recording, Size, film
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.doctor.base import material_of
from heatsplat.preparation.doctor import _photo_times, check, section
from heatsplat.preparation.frame import ThermalFrame
from heatsplat.preparation.frames import Reading
from heatsplat.preparation.given_poses import GivenPoses
from heatsplat.preparation.meaning import Meaning
from heatsplat.preparation.prepare import prepare


@functools.cache
def still(size: Size = SIZES["tiny"]) -> Recording:
    """A recording that several tests write as files, and nobody changes."""
    return film(Scene(PRESETS["static"]), size)


def test_a_clean_scene_has_no_findings_and_the_file_says_so(tmp_path):
    scene_files.write_colmap(still(), tmp_path / "scene")
    assert check(str(tmp_path / "scene"), tmp_path) == []
    assert json.loads((tmp_path / "doctor.json").read_text()) == []


def test_a_working_directory_that_takes_no_files_does_not_fail_what_was_found(tmp_path, caplog, monkeypatch):
    scene_files.write_colmap(still(), tmp_path / "scene")

    def refused(found, path):
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("heatsplat.preparation.doctor.write_findings", refused)
    assert check(str(tmp_path / "scene")) == []
    assert "doctor.json is not written" in caplog.text and "target=FOLDER" in caplog.text
    with pytest.raises(PermissionError):
        check(str(tmp_path / "scene"), tmp_path)


@pytest.mark.parametrize(
    ("layout", "told"),
    [
        ("colmap", "values: 16-bit counts in raw16/"),
        ("ntr", "points: vertices of mesh.obj"),
        ("thermo", "points: vertices of mesh.obj"),
        ("rhd", "temperature bounds: info.json"),
        ("rgbt_scenes", "times: none: the data set has no times"),
        ("thermoscenes", "temperature bounds: temperature_bounds.json"),
    ],
)
def test_scenes_of_every_layout_are_read_as_their_loaders_read_them(tmp_path, caplog, layout, told):
    getattr(scene_files, f"write_{layout}")(still(), tmp_path / "scene")
    with caplog.at_level("INFO"):
        assert check(str(tmp_path / "scene"), tmp_path) == []
    name = "nerfstudio" if layout == "thermoscenes" else layout  # whose layout it is
    assert f"read as data={name} reads it" in caplog.messages and told in caplog.text


def test_what_is_said_of_a_camera_s_files_is_refused_for_a_scene(tmp_path):
    scene_files.write_colmap(still(), tmp_path / "scene")
    with pytest.raises(SceneError, match="bounds_c changes nothing for the scene in .*: it is for a camera's files"):
        check(str(tmp_path / "scene"), tmp_path, bounds_c=[0, 50])
    with pytest.raises(SceneError, match="counts.scale changes nothing"):
        check(str(tmp_path / "scene"), tmp_path, counts={"offset_c": None, "scale": 0.01})


def test_dead_pixels_and_a_late_clock_are_found_in_a_camera_s_files(tmp_path):
    recording = still(Size(64, 52, 8, 60))
    write_camera(recording, tmp_path / "camera", Field(dead_pixels=5, rgb=True, rgb_clock_s=400.0))
    said = section(tmp_path / "camera")
    assert {"dead_pixels", "pairing"} <= {one["check"] for one in said.values["findings"]}


def test_a_look_at_files_says_what_it_could_not_look_at(tmp_path, caplog):
    recording = still(Size(64, 52, 8, 60))
    write_camera(recording, tmp_path / "camera")
    scene_files.write_colmap(recording, tmp_path / "scene")
    for folder, told in (("camera", True), ("scene", False)):
        caplog.clear()
        with caplog.at_level("INFO"):
            assert check(str(tmp_path / folder), tmp_path) == []
        assert ("once they are known" in caplog.text) == told
        assert ("8 frames of Synthetic Thermal 12, 64x52 pixels" in caplog.text) == told
        assert ("taken for kelvin x 100" in caplog.text) == told


def test_greys_that_the_camera_stretched_are_found_in_its_files_before_they_are_prepared(tmp_path):
    recording = still(Size(64, 52, 8, 60))
    low, high = float(recording.celsius.min()), float(recording.celsius.max())
    for name in ("stretched", "linear"):
        (tmp_path / name).mkdir()
        for i, frame in enumerate(recording.celsius):
            own = np.quantile(frame, (0.002, 0.998)) if name == "stretched" else (low - 1.0, high + 1.0)
            grey = np.rint(255.0 * np.clip((frame - own[0]) / (own[1] - own[0]), 0, 1)).astype(np.uint8)
            Image.fromarray(grey).save(tmp_path / name / f"{i}.png")
    reading = Reading(Meaning(bounds_c=(low - 1.0, high + 1.0)))
    said = {name: section(tmp_path / name, reading).values["findings"] for name in ("stretched", "linear")}
    assert said["stretched"][0]["check"] == "agc" and said["linear"] == []


@pytest.mark.usefixtures("dots_for_pictures")
def test_kelvin_in_a_scene_is_told_and_what_is_said_of_it_helps(tmp_path):
    recording = still(Size(64, 52, 8, 60))
    for name, kelvin in (("floats", 1.0), ("counts", 100.0)):
        scene_files.write_colmap(recording, tmp_path / name)
        (tmp_path / name / "temperature_bounds.json").unlink()
        shutil.rmtree(tmp_path / name / "raw16")
        for path, celsius in zip(sorted((tmp_path / name / "images").iterdir()), recording.celsius, strict=True):
            path.unlink()
            values = kelvin * (celsius.astype(np.float64) + 273.15)
            file = path if name == "counts" else path.with_suffix(".tiff")
            Image.fromarray(values.astype(np.uint16 if name == "counts" else np.float32)).save(file)
    model = tmp_path / "floats" / "sparse" / "0" / "images.bin"
    model.write_bytes(model.read_bytes().replace(b".png", b".tiff"))
    said = check(str(tmp_path / "floats"), tmp_path)
    assert any("may be kelvin" in one.what and "counts.offset_c=-273.15" in one.remedy for one in said)
    said = check(str(tmp_path / "counts"), tmp_path)
    assert any("kelvin x 100" in one.what and "data.raw=images data.raw_scale=0.01" in one.remedy for one in said)
    low, high = float(recording.celsius.min()), float(recording.celsius.max())
    scene = Colmap(root=str(tmp_path / "counts"), raw="images", raw_scale=0.01).scene
    assert low - 1 < scene.thermal_range.min_c < scene.thermal_range.max_c < high + 1
    assert material_of(scene).bounds_chosen and material_of(scene).stored == "counts"
    prepare(
        source=str(tmp_path / "floats" / "images"),
        target=tmp_path / "prepared",
        conditions={},
        uncertainty={},
        counts={"offset_c": -273.15},
        poses=GivenPoses(str(tmp_path / "floats")),
    )
    scene = Colmap(root=str(tmp_path / "prepared")).scene
    assert not material_of(scene).bounds_chosen and material_of(scene).stored == "celsius"
    bounds = scene.thermal_range
    assert (bounds.min_c, bounds.max_c) == pytest.approx((low, high), abs=0.5)


def test_clocks_of_which_one_says_no_zone_may_be_hours_apart(tmp_path):
    recording = still(Size(64, 52, 8, 60))
    write_camera(recording, tmp_path / "camera", Field(rgb=True))
    frames = read_frames(tmp_path / "camera")

    def photos(hours: float, minutes: float = 0.0, zone: str = "") -> list[ThermalFrame]:
        """The frames with photos of their moments, by a clock that shows the time of another zone."""
        found = []
        for number, frame in enumerate(frames):
            exif = Image.Exif()
            shown = frame.time.replace(tzinfo=None) + timedelta(hours=hours, minutes=minutes)
            exif.get_ifd(0x8769)[0x9003] = shown.strftime("%Y:%m:%d %H:%M:%S")
            exif.get_ifd(0x8769)[0x9291] = f"{shown.microsecond:06d}"
            if zone:
                exif.get_ifd(0x8769)[0x9011] = zone
            Image.new("L", (8, 8)).save(tmp_path / f"{number}.jpg", exif=exif)
            found.append(replace(frame, rgb=tmp_path / f"{number}.jpg"))
        return found

    def apart(photos: list[ThermalFrame], zone: str | None = None) -> float:
        times = _photo_times(photos, zone)
        return float(np.median(np.array(times) - [frame.time.timestamp() for frame in photos]))

    assert frames[0].time.tzinfo is not None
    assert apart(photos(2.0)) == pytest.approx(0.0, abs=1e-3)
    assert apart(photos(2.0, minutes=1.5)) == pytest.approx(90.0, abs=1e-3)
    assert apart(photos(2.0), "+01:00") == pytest.approx(3600.0, abs=1e-3)  # it is told, so an hour is an hour
    assert apart(photos(2.0, zone="+02:00")) == pytest.approx(0.0, abs=1e-3)
    assert apart(photos(2.0, zone="+00:00")) == pytest.approx(7200.0, abs=1e-3)


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(SceneError, match="nowhere"):
        check(str(tmp_path / "nowhere"))


def test_a_scene_of_the_protocol_is_read_with_its_bounds_weather_and_test_images(tmp_path, caplog):
    scene = Synthetic(scene="static", size="tiny", split="parts", parts={"near": 8, "views": 0.12, "times": None}).scene
    write_scene(scene, tmp_path / "scenes" / "hall", tmp_path / "truth" / "hall", {"protocol": 1, "size": "tiny"})
    with caplog.at_level("INFO"):
        check(str(tmp_path / "scenes" / "hall"), tmp_path)
    assert "read as data=benchmark reads it" in caplog.messages
    with pytest.raises(SceneError, match=r"holds 1 scene of the protocol: give one, such as .*scenes/hall"):
        check(str(tmp_path), tmp_path)
    shutil.rmtree(tmp_path / "truth")  # which is not handed out
    caplog.clear()
    with caplog.at_level("INFO"):
        check(str(tmp_path / "scenes" / "hall"), tmp_path)
    assert "read as data=nerfstudio reads it" in caplog.messages and "4 of 19 frames without" in caplog.text
