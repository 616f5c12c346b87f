"""The doctor on folders: a scene that trains, and a camera's files."""

import json

import pytest

from heatsplat.contracts import SceneError
from heatsplat.datamodules.synthetic_scene.camera_folder import Field, write_camera
from heatsplat.datamodules.synthetic_scene.film import SIZES, Size, film
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.datamodules.synthetic_scene.writers import write_colmap
from heatsplat.preparation.doctor import check, section


def test_a_clean_scene_has_no_findings_and_the_file_says_so(tmp_path):
    write_colmap(film(Scene(PRESETS["static"]), SIZES["tiny"]), tmp_path / "scene")
    assert check(str(tmp_path / "scene"), tmp_path) == []
    assert json.loads((tmp_path / "doctor.json").read_text()) == []


def test_dead_pixels_and_a_late_clock_are_found_in_a_camera_s_files(tmp_path):
    recording = film(Scene(PRESETS["static"]), Size(64, 52, 8, 60))
    write_camera(recording, tmp_path / "camera", Field(dead_pixels=5, rgb=True, rgb_clock_s=400.0))
    said = section(tmp_path / "camera")
    assert {"dead_pixels", "pairing"} <= {one["check"] for one in said.values["findings"]}


def test_a_folder_that_is_not_there_is_named(tmp_path):
    with pytest.raises(SceneError, match="nowhere"):
        check(str(tmp_path / "nowhere"))
