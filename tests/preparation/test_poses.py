"""Cameras that are found from thermal frames alone, against those that filmed them."""

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch

from benchmarks.camera_folder import Field, flight, write_camera
from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.colmap import read_model
from heatsplat.datamodules.formats.colmap_library import pycolmap
from heatsplat.datamodules.synthetic_scene.film import Size
from heatsplat.geometry.alignment import pose_errors
from heatsplat.preparation.conditions import GivenConditions
from heatsplat.preparation.features import Sift
from heatsplat.preparation.frame import CameraInfo, Position, ThermalFrame
from heatsplat.preparation.frames import Reading, read_recording
from heatsplat.preparation.poses import FindPoses, Search


def search_of(tmp_path: Path, frames: int, **options) -> Search:
    (tmp_path / "images").mkdir()
    start, found = datetime(2024, 7, 1, tzinfo=UTC), []
    for i in range(frames):
        (tmp_path / "images" / f"f{i:03d}.tif").touch()
        (tmp_path / f"f{i:03d}.tif").touch()
        place = Position(51.0 + 1e-4 * i, 4.0, 75.0)
        found.append(
            ThermalFrame(
                f"f{i:03d}",
                tmp_path / f"f{i:03d}.tif",
                0,
                lambda: np.zeros((4, 4), np.float32),
                time=start + timedelta(seconds=i),
                position=place,
            )
        )
    return Search(FindPoses(Sift(), **options), found, tmp_path)


def test_heights_of_all_frames_have_one_zero(tmp_path):
    """A file may lack one of the two: metres above take-off beside metres above the sea would be a cliff."""
    search = search_of(tmp_path, 5)
    names = list(search.frames)

    def heights(*told: tuple[float | None, float | None]) -> list[float | None]:
        for i, (sea, takeoff) in enumerate(told):
            position = Position(51.0 + 1e-4 * i, 4.0, sea, takeoff)
            search.frames[names[i]] = replace(search.frames[names[i]], position=position)
        search.__dict__.pop("_height", None)
        fixes = [search._fix(search.frames[name]) for name in names]
        return [fix and fix[2] for fix in fixes]

    assert heights(*[(575.0, 75.0)] * 5) == [75.0] * 5
    assert heights(*[(575.0, 75.0)] * 4, (575.0, None)) == [575.0] * 5
    assert heights(*[(None, 75.0)] * 4, (575.0, None)) == [75.0] * 4 + [None]
    assert heights(*[(None, None)] * 5) == [0.0] * 5


def test_few_frames_are_all_matched_and_a_video_only_with_its_neighbours(tmp_path):
    search = search_of(tmp_path, 30, all_pairs=10, overlap=2)
    pairs = search.pairs()
    assert len(pairs) < 30 * 29 / 2 and len(pairs) == len(set(pairs))
    assert {(f"f{i:03d}.tif", f"f{i + step:03d}.tif") for i in range(20) for step in (1, 2, 4, 8)} <= set(pairs)
    search.options = FindPoses(Sift(), video=False)
    assert len(search.pairs()) == 30 * 29 / 2


def test_a_search_goes_on_and_begins_anew_where_frames_or_settings_have_changed(tmp_path):
    search = search_of(tmp_path, 4)
    search.begin()
    left = search.work / "database.db"

    def stays(options: FindPoses, **conditions: float) -> bool:
        left.touch()
        frames = [GivenConditions(**conditions).settled(frame) for frame in search.frames.values()]
        again = Search(options, frames, tmp_path)
        again.begin()
        return left.is_file()

    assert stays(FindPoses(Sift())) and stays(FindPoses(Sift()))
    assert not stays(FindPoses(Sift(most=99))) and stays(FindPoses(Sift(most=99)))
    assert not stays(FindPoses(Sift(most=99), clip=2.0)) and not stays(FindPoses(Sift()))
    (tmp_path / "images" / "f002.tif").write_bytes(b"corrected for another emissivity")
    assert stays(FindPoses(Sift()), emissivity=0.9, reflected_c=-20.0)
    (tmp_path / "f002.tif").write_bytes(b"another recording")
    assert not stays(FindPoses(Sift())) and stays(FindPoses(Sift()))


def test_focal_lengths_are_told_by_one_frame_of_a_camera(tmp_path):
    """A field of view needs the width of an image: read for each frame that would be the whole recording."""
    loaded = []

    def load() -> np.ndarray:
        loaded.append(True)
        return np.zeros((4, 8), np.float32)

    wide = CameraInfo(field_of_view_deg=90.0)
    frames = [replace(frame, camera=wide, load=load) for frame in search_of(tmp_path, 6).frames.values()]
    search = Search(FindPoses(Sift()), frames, tmp_path)
    camera = SimpleNamespace(params=[1.0, 4.0, 2.0], focal_length_idxs=lambda: [0], has_prior_focal_length=False)
    database = SimpleNamespace(
        read_all_images=lambda: [SimpleNamespace(name=copy, camera_id=1) for copy in search.name_of],
        read_camera=lambda number: camera,
        update_camera=lambda changed: None,
    )
    search._set_focal_lengths(database)
    assert camera.params == [pytest.approx(4.0), 4.0, 2.0] and camera.has_prior_focal_length
    assert len(loaded) == 1


def test_the_database_is_asked_for_a_camera_until_it_has_one(tmp_path, monkeypatch):
    """It lists all of its images each time: asked for every frame, that is their square."""
    search, asked = search_of(tmp_path, 6), []
    rng = np.random.default_rng(0)
    for copy in search.name_of:
        (search.work / "images" / copy).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(search.work / "images" / copy), rng.integers(0, 255, (48, 64)).astype(np.uint8))
    own = Search._camera_of
    monkeypatch.setattr(Search, "_camera_of", lambda *given: asked.append(given) or own(*given))
    search.find_features()
    assert len(asked) == 2  # the first image has none yet
    with pycolmap.Database.open(search.database) as database:
        images = database.read_all_images()
    assert len(images) == 6 and len({image.camera_id for image in images}) == 1


def test_gps_counts_where_it_tells_frames_apart(tmp_path):
    assert search_of(tmp_path, 5).origin is not None
    (tmp_path / "b").mkdir()
    assert search_of(tmp_path / "b", 5, gps_sd_m=(30.0, 30.0)).origin is None  # they lie within 45 m of each other


def test_two_frames_and_photos_that_are_missing_are_refused(tmp_path):
    with pytest.raises(SceneError, match="2 frames cannot tell"):
        search_of(tmp_path, 2)
    (tmp_path / "b").mkdir()
    with pytest.raises(SceneError, match="no photo"):
        search_of(tmp_path / "b", 4, by="rgb")


def test_a_few_frames_of_a_camera_that_stands_still_are_no_cameras(tmp_path):
    search = search_of(tmp_path, 9)
    picture = np.random.default_rng(0).integers(0, 255, (32, 40)).astype(np.uint8)
    for copy in search.copy_of.values():
        path = search.work / "images" / copy
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), picture)
    placed = [SimpleNamespace(name=copy, has_pose=True) for copy in list(search.copy_of.values())[:4]]
    with pytest.raises(SceneError, match="the image does not move"):
        search.finish(SimpleNamespace(images=dict(enumerate(placed)), num_points3D=lambda: 9), [])
    assert not (tmp_path / "sparse").exists()


def test_cameras_that_see_no_point_are_none(tmp_path):
    (tmp_path / "images").mkdir()
    frames = []
    for i, picture in enumerate(np.random.default_rng(0).normal(0.0, 40.0, (3, 128, 160)).astype(np.float32)):
        (tmp_path / "images" / f"{i}.tiff").touch()
        smooth = cv2.GaussianBlur(picture, (0, 0), 4)
        frames.append(ThermalFrame(f"{i}", Path(f"{i}.tiff"), 0, lambda smooth=smooth: smooth))
    search = Search(FindPoses(Sift()), frames, tmp_path)
    search.copies()
    search.find_features()
    placed = {i: SimpleNamespace(name=copy, has_pose=True) for i, copy in enumerate(search.name_of)}
    with pytest.raises(SceneError, match="no cameras could be found: frames have .* features"):
        search.finish(SimpleNamespace(images=placed, num_points3D=lambda: 0), [])


@pytest.mark.slow
def test_cameras_are_found_from_thermal_frames_with_drift_dead_pixels_and_gps_noise(tmp_path):
    recording = flight(Size(320, 256, 24, 200), duration_s=120.0)
    write_camera(recording, tmp_path / "source", Field((47.0, 9.0, 500.0), 0.5, drift_k=0.08, dead_pixels=40))
    frames = read_recording(tmp_path / "source", Reading()).frames
    models = []
    for target in (tmp_path / "one", tmp_path / "two"):
        (target / "images").mkdir(parents=True)
        for frame in frames:
            (target / "images" / f"{frame.name}.tiff").symlink_to(frame.path)
        said = FindPoses(Sift(most=1500), gps_sd_m=(0.5, 0.5))(frames, target)
        models.append(read_model(target))
        assert json.loads((target / "world.json").read_text()) == {"metres_per_unit": 1.0, "axes": "east, north, up"}
    assert said.values["registered"] == 24 and said.values["metres_per_unit"] == 1.0
    errors = pose_errors(torch.from_numpy(np.stack(models[0].viewmats)), torch.from_numpy(recording.viewmats))
    assert errors.degrees.median() < 0.5 and errors.percent.median() < 1.0
    assert float(errors.similarity.scale) == pytest.approx(1.0, abs=0.02)
    np.testing.assert_array_equal(np.stack(models[0].viewmats), np.stack(models[1].viewmats))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"focal_px": -5}, "poses.focal_px must be above 0, got -5"),
        ({"overlap": 0}, "poses.overlap"),
        ({"clip": "much"}, "poses.clip must be a number"),
        ({"gps_sd_m": 2.0}, "poses.gps_sd_m must be a list of 2 numbers"),
        ({"gps_sd_m": [2.0, 0.0]}, "poses.gps_sd_m must be above 0"),
        ({"all_pairs": "few"}, "poses.all_pairs"),
        ({"all_pairs": -3}, "poses.all_pairs must be 0 or above, got -3"),
        ({"camera_model": "RADIALL"}, "poses.camera_model must be one of SIMPLE_PINHOLE"),
        ({"video": "yes"}, "poses.video"),
    ],
)
def test_settings_that_cannot_be_are_refused_before_any_work(wrong, said):
    with pytest.raises(SceneError, match=said):
        FindPoses(Sift(), **wrong)


def test_features_that_cannot_be_found_are_refused():
    for wrong in ({"most": 0}, {"ratio": "x"}, {"peak": -1.0}):
        with pytest.raises(SceneError, match=f"poses.features.{next(iter(wrong))}"):
            Sift(**wrong)
