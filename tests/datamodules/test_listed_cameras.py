"""Cameras that a file lists, from which a trained scene is looked at."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from layouts import names, write_colmap

from heatsplat.contracts import SceneError
from heatsplat.datamodules.colmap import Colmap
from heatsplat.datamodules.listed_cameras import ListedCameras
from heatsplat.geometry.transforms import OPENGL_AXES

LENS = {"camera_model": "PINHOLE", "w": 40, "h": 32, "fl_x": 38.0, "fl_y": 37.0, "cx": 19.0, "cy": 15.5}
POSE = [[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 1.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def written(folder: Path, *frames: dict, **values) -> Path:
    path = folder / "cameras.json"
    path.write_text(json.dumps({**LENS, **values, "frames": [{"transform_matrix": POSE, **frame} for frame in frames]}))
    return path


def test_cameras_of_a_transforms_file_need_neither_names_nor_images(tmp_path):
    path = written(tmp_path, {}, {"file_path": "left/a.png", "time_s": 12.5, "fl_x": 76.0})
    first, second = ListedCameras(path).frames
    assert (first.name, second.name) == ("camera_0000.png", "left/a.png")
    assert (first.time_s, second.time_s) == (None, 12.5)
    assert (first.camera.width, first.camera.height) == (40, 32)
    assert torch.linalg.inv(first.camera.viewmat).numpy() == pytest.approx(np.array(POSE) @ OPENGL_AXES)
    assert first.camera.K.tolist() == [[38.0, 0.0, 19.0], [0.0, 37.0, 15.5], [0.0, 0.0, 1.0]]
    assert second.camera.K[0, 0] == 76.0


def test_several_files_stand_one_after_the_other(tmp_path):
    paths = [tmp_path / name / "camera.json" for name in "ab"]
    for path in paths:
        path.parent.mkdir()
        written(path.parent, {"file_path": "view.png"}).rename(path)
    frames = ListedCameras([str(path) for path in paths]).frames
    assert [(frame.name, frame.frame_id) for frame in frames] == [("view_0000.png", 0), ("view_0001.png", 1)]


@pytest.mark.parametrize("inner", ["", "sparse/0"])
def test_cameras_of_a_colmap_model(tmp_path, inner):
    write_colmap(tmp_path, names(3))
    scene = Colmap(root=str(tmp_path), split="all").scene
    found = ListedCameras(tmp_path / inner).frames
    assert [frame.name for frame in found] == [frame.name for frame in scene.train.frames]
    for ours, own in zip(found, scene.train.frames, strict=True):
        assert torch.equal(ours.camera.viewmat, own.camera.viewmat) and torch.equal(ours.camera.K, own.camera.K)


def test_in_a_scene_they_lie_about_its_origin_and_dates_are_on_its_clock(tmp_path):
    write_colmap(tmp_path, names(3))
    scene = Colmap(root=str(tmp_path)).scene
    listed = ListedCameras(written(tmp_path, {}, {"time_s": 60}, {"time": "2024-08-06T15:35:00"}))
    with pytest.raises(SceneError, match="camera camera_0002.png has a date, and nothing tells the clock of the scene"):
        listed.in_scene(scene)
    notes = {"clock_at_zero_s": listed.frames[2].time_s - 90.0, "origin": [1e6, 2e6, 0.0]}
    placed = listed.in_scene(replace(scene, notes=notes))
    assert [frame.time_s for frame in placed] == [None, 60.0, 90.0]
    moved = placed[0].camera.center + torch.tensor(notes["origin"], dtype=torch.float64)
    assert moved.tolist() == pytest.approx([1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"w": None}, "cameras.json"),
        ({"frames": []}, "cameras.json has no frames"),
        ({"camera_path": [{}]}, "cameras.json is a camera path of nerfstudio's viewer"),
        ({"frames": [{"file_path": "a.png"}]}, "cameras.json: frame 0 has no key 'transform_matrix'"),
        (
            {"frames": [{"transform_matrix": (2 * np.eye(4)).tolist()}]},
            "cameras.json: transform_matrix of camera_0000.png",
        ),
    ],
)
def test_what_is_no_camera_is_named(tmp_path, values, message):
    path = written(tmp_path, {})
    told = {**json.loads(path.read_text()), **values}
    path.write_text(json.dumps({key: value for key, value in told.items() if value is not None}))
    with pytest.raises(SceneError, match=message):
        ListedCameras(path)


def test_size_and_place_are_asked_for(tmp_path):
    path = written(tmp_path, {})
    told = json.loads(path.read_text())
    path.write_text(json.dumps({key: value for key, value in told.items() if key not in ("w", "h")}))
    with pytest.raises(SceneError, match="cameras.json lacks w and h"):
        ListedCameras(path)
    with pytest.raises(SceneError, match="there is no such file or folder; give a transforms.json"):
        ListedCameras(tmp_path / "none.json")
    with pytest.raises(SceneError, match="holds no COLMAP model; give its folder"):
        ListedCameras(tmp_path)


def test_a_lens_that_distorts_is_rendered_without_and_told(tmp_path, caplog):
    (frame,) = ListedCameras(written(tmp_path, {}, camera_model="OPENCV", k1=0.1)).frames
    assert "lenses distort; images are rendered as by lenses that do not" in caplog.text
    assert frame.camera.K[0, 0] == 38.0
