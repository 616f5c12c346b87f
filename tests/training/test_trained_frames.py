"""A run on a folder that was changed since: what is looked at from other places is refused, what is right goes on."""

import json
import logging
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch
from running import TINY, run

from heatsplat.contracts import SceneError, ViewSet
from heatsplat.datamodules.nerfstudio import Nerfstudio
from heatsplat.runs.run import load
from heatsplat.training.checkpoints import CheckpointFiles, load_checkpoint
from heatsplat.training.trained_frames import check_frames, frames_of

COUNT, WIDTH, HEIGHT = 14, 40, 32
RUN = (*TINY[1:], "data=nerfstudio", "data.random_points=200", "max_steps=4")  # without the size of the synthetic scene


def write_scene(folder, count=COUNT, turn=0.0):
    """A folder of ``count`` images from a circle, which ``turn`` moves along it (rad)."""
    frames = []
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for number in range(count):
        angle = 2 * np.pi * number / COUNT + turn
        eye = 4 * np.array([np.cos(angle), np.sin(angle), 0.25])
        back = eye / np.linalg.norm(eye)
        right = np.cross([0, 0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, eye], axis=1)
        name = f"images/frame_{number:02d}.png"
        y, x = np.mgrid[:HEIGHT, :WIDTH]
        cv2.imwrite(str(folder / name), (3 * x + 2 * y + 5 * number).astype(np.uint8))
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    lens = {"fl_x": 38.0, "fl_y": 38.0, "cx": 20.0, "cy": 16.0, "w": WIDTH, "h": HEIGHT}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    return folder


def scene_in(folder, **options):
    return Nerfstudio(root=str(folder), random_points=50, **options).scene


@pytest.fixture(scope="module")
def ckpt(tmp_path_factory):
    """The checkpoint of a run on a folder, beside that folder ``data``."""
    place = tmp_path_factory.mktemp("trained")
    run(place / "run", *RUN, "method=3dgs", f"data.root={write_scene(place / 'data')}", "test=false")
    return place / "run" / "checkpoints" / "last.ckpt"


def test_what_is_right_goes_on(ckpt, tmp_path):
    data = ckpt.parents[2] / "data"
    assert load(ckpt).scene.train.frames
    assert load(ckpt, {"downscale": 2}).scene.train.frames[0].camera.width == WIDTH // 2
    assert load(ckpt, {"split": "block"}).scene.train.frames
    assert load(ckpt, {"root": str(shutil.copytree(data, tmp_path / "data"))}).scene.train.frames  # elsewhere
    text = json.loads((data / "transforms.json").read_text())
    for frame in text["frames"]:
        frame["transform_matrix"] = np.round(frame["transform_matrix"], 6).tolist()  # last digits
    (tmp_path / "data" / "transforms.json").write_text(json.dumps(text))
    assert load(ckpt, {"root": str(tmp_path / "data")}).scene.train.frames


def test_test_images_that_were_trained_on_are_told(ckpt, caplog):
    load(ckpt, {"downscale": 2})
    load(ckpt, {"split": "all"})  # of which the data say it themselves
    assert "were trained on" not in caplog.text
    load(ckpt, {"split": "block"})
    assert "2 of the 2 test images of scene 'data' were trained on (frame_06.png, frame_07.png): " in caplog.text


def test_a_run_whose_test_views_were_listed_is_looked_at_with_another_split(ckpt, tmp_path):
    stored = load_checkpoint(ckpt)
    stored["heatsplat"]["config"]["data"] |= {"split": "list", "split_file": "list.txt"}
    CheckpointFiles().save_checkpoint(stored, tmp_path / "listed.ckpt")
    assert load(tmp_path / "listed.ckpt", {"split": "block"}).data.split.rule == "block"
    with pytest.raises(SceneError, match="data.split_file=list.txt: there is no file"):
        load(tmp_path / "listed.ckpt")


def test_other_cameras_are_refused_with_how_far_they_moved(ckpt, tmp_path):
    moved = write_scene(tmp_path / "moved", turn=0.1)
    with pytest.raises(
        SceneError, match=r"last.ckpt: .*cameras of 12 of its 12 .*0.4 world units and 5.73 degrees.*root"
    ):
        load(ckpt, {"root": str(moved), "scene": None})


def test_frames_that_came_or_went_are_refused_with_their_names(ckpt, tmp_path):
    more = write_scene(tmp_path / "more", COUNT + 1)
    with pytest.raises(SceneError, match=r"1 training frame \(frame_14.png\) more"):
        load(ckpt, {"root": str(more)})
    fewer = write_scene(tmp_path / "fewer", COUNT - 2)
    with pytest.raises(SceneError, match=r"2 training frames \(frame_12.png, frame_13.png\) less"):
        load(ckpt, {"root": str(fewer)})


def test_a_model_with_values_of_each_frame_needs_these(tmp_path):
    data = write_scene(tmp_path / "data")
    run(tmp_path / "run", *RUN, "method=3dgs", "sensor=frame_offset", f"data.root={data}", "test=false")
    last = tmp_path / "run" / "checkpoints" / "last.ckpt"
    assert load(last)
    with pytest.raises(SceneError, match="training frame.*more.*data.split"):
        load(last, {"split": "block"})


def test_a_model_that_knows_frames_by_their_numbers_needs_these(tmp_path):
    data = write_scene(tmp_path / "data")
    (data / "test.txt").write_text("frame_00\nframe_08\n")
    split = ("data.split=list", "data.split_file=test.txt")
    for method in ("thermal3dgs", "3dgs"):  # of which the first tells images without times by their numbers
        run(tmp_path / method, *RUN, f"method={method}", *split, f"data.root={data}", "test=false")
    indexed, plain = (tmp_path / method / "checkpoints" / "last.ckpt" for method in ("thermal3dgs", "3dgs"))
    assert load(indexed, {"split": "block"}) and load(indexed)
    told = json.loads((data / "transforms.json").read_text())
    told["frames"] = told["frames"][1:]  # a test frame is gone
    (data / "transforms.json").write_text(json.dumps(told))
    (data / "test.txt").write_text("frame_08\n")
    assert load(plain)
    with pytest.raises(SceneError, match="its frames are numbered in another way"):
        load(indexed)


def test_training_does_not_go_on_with_other_images(ckpt, tmp_path):
    for name, scene in {"cameras of 12": {"turn": 0.1}, "training frames? .* more": {"count": COUNT + 3}}.items():
        other = write_scene(tmp_path / name[:4] / "data", **scene)
        with pytest.raises(SceneError, match=name):
            run(tmp_path / "on", *RUN, "method=3dgs", f"data.root={other}", "max_steps=6", f"ckpt={ckpt}")
    data = ckpt.parents[2] / "data"
    _, trainer = run(
        tmp_path / "right", *RUN, "method=3dgs", f"data.root={data}", "max_steps=6", f"ckpt={ckpt}", "test=false"
    )
    assert trainer.global_step == 6


def test_data_that_were_moved_are_asked_for(ckpt, tmp_path):
    data = ckpt.parents[2] / "data"
    moved = data.rename(tmp_path / "elsewhere")
    try:
        with pytest.raises(
            SceneError, match="last.ckpt: its data are not at data.root=.*/data any more; .* data.root=FOLDER"
        ):
            load(ckpt)
        assert load(ckpt, {"root": str(moved)}).scene.name == "elsewhere"
    finally:
        moved.rename(data)


def test_a_checkpoint_that_does_not_tell_its_frames_loads(ckpt, tmp_path):
    stored = load_checkpoint(ckpt)
    stored["heatsplat"]["scales"].pop("frames")
    CheckpointFiles().save_checkpoint(stored, tmp_path / "old.ckpt")
    assert load(tmp_path / "old.ckpt", {"root": str(write_scene(tmp_path / "data", turn=0.1))})


def test_gaussians_of_a_run_in_another_world_are_warned_of(ckpt, tmp_path, caplog):
    other = write_scene(tmp_path / "data", turn=0.1)
    with caplog.at_level(logging.WARNING):
        run(
            tmp_path / "on",
            *RUN,
            "method=3dgs",
            f"data.root={other}",
            "init=pretrained",
            f"init.path={ckpt}",
            "test=false",
        )
    assert "cameras of" in caplog.text and "not in the world of this scene" in caplog.text


def test_moments_that_changed_are_refused(tmp_path):
    scene = scene_in(write_scene(tmp_path))

    def timed(gap):
        frames = [replace(frame, time_s=gap * row) for row, frame in enumerate(scene.train.frames)]
        return replace(scene, train=ViewSet(frames, None))

    check_frames(frames_of(timed(10.0)), timed(10.0 + 1e-6))
    with pytest.raises(SceneError, match="times of 11 training frames differ by up to 22 s"):
        check_frames(frames_of(timed(10.0)), timed(12.0))


@pytest.mark.parametrize(("moved", "told"), [(1e-9, False), (1e-3, True)])
def test_of_a_camera_on_a_tripod_the_last_digits_of_its_place_are_no_movement(moved, told, tmp_path):
    write_scene(tmp_path)
    scene = scene_in(tmp_path)

    def on_a_tripod(aside):
        camera = scene.train.frames[0].camera
        viewmat = camera.viewmat.clone()
        viewmat[0, 3] += aside * scene.distance
        frames = [replace(frame, camera=replace(camera, viewmat=viewmat)) for frame in scene.train.frames]
        return replace(scene, train=ViewSet(frames, lambda i: scene.train[i]))

    before = frames_of(on_a_tripod(0.0))
    check_frames(before, on_a_tripod(0.0))
    if told:
        with pytest.raises(SceneError, match="training frames moved by up to"):
            check_frames(before, on_a_tripod(moved))
    else:
        check_frames(before, on_a_tripod(moved))


def test_frames_of_one_name_are_no_others(tmp_path):
    scene = scene_in(write_scene(tmp_path))
    same = replace(scene, train=ViewSet([replace(frame, name="a.png") for frame in scene.train.frames], None))
    check_frames(frames_of(same), same, exactly=True)
    assert torch.equal(frames_of(same)["viewmats"], frames_of(scene)["viewmats"])
