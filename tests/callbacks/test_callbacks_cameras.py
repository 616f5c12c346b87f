"""What a run leaves of cameras that it learned: a file that other programs read, and none where nothing was learned."""

import json
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from fake_run import FakeModule, wall

from heatsplat.callbacks.cameras import CAMERAS_FILE, LearnedCameras
from heatsplat.datamodules.formats.nerfstudio import read_transforms, viewmat_of


def left_by(tmp_path, scene, cameras):
    module = FakeModule(scene, tmp_path)
    module.cameras = cameras
    LearnedCameras().on_test_epoch_end(SimpleNamespace(), module)
    return tmp_path / CAMERAS_FILE


def test_learned_cameras_are_read_by_our_own_loader_as_they_stood(tmp_path):
    scene = wall()
    beside = torch.eye(4, dtype=torch.float64)
    beside[0, 3] = 0.25

    def of(frame):
        return replace(frame.camera, viewmat=(beside @ frame.camera.viewmat.double()).requires_grad_())

    transforms = read_transforms(left_by(tmp_path, scene, SimpleNamespace(learns=True, of=of)))
    assert [frame["file_path"] for frame in transforms.frames] == [frame.name for frame in scene.train.frames]
    assert [frame["time_s"] for frame in transforms.frames] == scene.train.times_s
    for entry, frame in zip(transforms.frames, scene.train.frames, strict=True):
        assert viewmat_of(transforms, entry, opengl=True) == pytest.approx(
            (beside @ frame.camera.viewmat.double()).numpy(), abs=1e-12
        )


def test_images_without_times_get_none(tmp_path):
    frames = [replace(frame, time_s=None) for frame in wall().train.frames]
    cameras = SimpleNamespace(learns=True, of=lambda frame: frame.camera)
    scene = SimpleNamespace(train=SimpleNamespace(frames=frames), notes={})
    LearnedCameras().on_test_epoch_end(None, SimpleNamespace(cameras=cameras, scene=scene, output_dir=tmp_path))
    assert all("time_s" not in frame for frame in json.loads((tmp_path / CAMERAS_FILE).read_text())["frames"])


def test_given_cameras_leave_no_file(tmp_path):
    assert not left_by(tmp_path, wall(), SimpleNamespace(learns=False)).exists()


def test_a_file_that_cannot_be_written_whole_leaves_the_one_that_was_there(tmp_path, monkeypatch):
    def full(*_):
        raise OSError("No space left on device")

    cameras = SimpleNamespace(learns=True, of=lambda frame: frame.camera)
    before = left_by(tmp_path, wall(), cameras).read_text()
    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        left_by(tmp_path, wall(), SimpleNamespace(learns=True, of=lambda frame: wall().train.frames[0].camera))
    assert (tmp_path / CAMERAS_FILE).read_text() == before
