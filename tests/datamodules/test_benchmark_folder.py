"""Scenes of a protocol on disk: what is handed out, what is kept, and what a reader of COLMAP or nerfstudio makes of it."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from heatsplat.contracts import SceneError, ViewSet
from heatsplat.datamodules.benchmark_folder import write_scene, write_scenes
from heatsplat.datamodules.formats.colmap import read_model
from heatsplat.datamodules.formats.images import read_image
from heatsplat.datamodules.synthetic import Synthetic

PARTS = {"near": 8, "views": 0.12, "times": [[0.45, 0.55], [0.9, 1.0]]}
PROTOCOL = {
    "version": 1, "size": "tiny", "scene_seed": 0, "parts": PARTS,
    "scenes": {
        "cooling": {"data": {"scene": "cooling"}},
        "coarse_camera": {"data": {"scene": "noisy_sensor", "degrade": "area4"}},
    },
}  # fmt: skip


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("protocol")
    write_scenes(folder, PROTOCOL)
    return folder


def names(path) -> set[str]:
    return {file.stem for file in path.iterdir() if file.is_file()}


def test_what_is_handed_out_holds_no_pixel_of_a_held_out_view(root):
    scene, truth = root / "scenes" / "cooling", root / "truth" / "cooling"
    listed = {
        subset: {json_frame["thermal_file_path"].split("/")[1].split(".")[0] for json_frame in
                 json.loads((scene / f"transforms_{subset}.json").read_text())["frames"]}
        for subset in ("train", "test")
    }  # fmt: skip
    assert names(scene / "thermal") == names(scene / "images") == listed["train"]
    assert names(truth) - {"materials"} == names(truth / "images") == listed["test"]
    assert {name.rpartition("_")[0] for name in listed["test"]} == {"near", "views", "times"}
    assert sorted(read_model(scene).names) == sorted(f"{name}.tiff" for name in listed["train"])
    known = np.genfromtxt(truth / "materials.csv", delimiter=",", names=True)
    assert (
        set(known["heat_capacity_j_m3_k"]) >= {1.4e6, 1.0e6} and len(known) > 300 and set(known["emissivity"]) == {1.0}
    )
    meta = json.loads((scene / "meta.json").read_text())
    assert meta["ambient_c"] == 22.0 and meta["metres_per_unit"] == 1.0 and meta["size"] == "tiny"


def test_training_images_are_recorded_and_the_truth_is_exact(root):
    clean = {view.frame.name[-9:-4]: view for view in Synthetic(scene="cooling", size="tiny", noise_k=0.0).scene.test}
    exact = Synthetic(scene="cooling", size="tiny", split="parts", parts=PARTS)
    view = next(view for view in exact.scene.test if view.frame.name[-9:-4] in clean)
    stored = read_image(root / "truth" / "cooling" / view.frame.name.replace("png", "tiff"))
    known = clean[view.frame.name[-9:-4]]
    assert np.abs(stored - exact.scene.thermal_range.to_celsius(known.thermal[..., 0].numpy())).max() < 2e-3
    noise = stored - exact.scene.thermal_range.to_celsius(view.thermal[..., 0].numpy())
    assert 0.03 < np.std(noise) < 0.07


def test_a_coarse_camera_trains_on_less_than_is_asked_for(root):
    folder = root / "scenes" / "coarse_camera"
    train, test = (
        json.loads((folder / f"transforms_{subset}.json").read_text())["frames"][0] for subset in ("train", "test")
    )
    assert (train["w"], train["h"], test["w"], test["h"]) == (16, 13, 64, 52)
    assert train["fl_x"] == pytest.approx(test["fl_x"] / 4)
    assert read_image(folder / train["thermal_file_path"]).shape == (13, 16)


def test_what_is_there_stays_and_another_size_is_refused(root, tmp_path):
    meta = root / "scenes" / "cooling" / "meta.json"
    before = meta.stat().st_mtime_ns
    write_scenes(root, PROTOCOL, scenes=["cooling"])
    assert meta.stat().st_mtime_ns == before
    with pytest.raises(SceneError, match="was written with another size: delete it"):
        write_scenes(root, PROTOCOL, size="demo", scenes=["cooling"])
    changed = {"scene_seed": 7, "parts": PARTS | {"near": 4}}
    with pytest.raises(SceneError, match="was written with another scene_seed and options: delete it"):
        write_scenes(root, PROTOCOL | changed, scenes=["cooling"])
    with pytest.raises(SceneError, match="there is no boiling; there are cooling, coarse_camera"):
        write_scenes(root, PROTOCOL, scenes=["boiling"])
    without = replace(Synthetic(scene="static", size="tiny", frames=4).scene, thermal_range=None)
    with pytest.raises(SceneError, match="scene static has no temperatures"):
        write_scene(without, tmp_path / "scene", tmp_path / "truth", {})


def test_images_of_several_cameras_keep_their_lenses(tmp_path):
    scene = Synthetic(scene="cooling", size="tiny").scene
    other = replace(
        scene.train.frames[1].camera, K=scene.train.frames[1].camera.K * torch.tensor([[2.0], [1.0], [1.0]])
    )
    frames = [replace(frame, camera=other) if i == 1 else frame for i, frame in enumerate(scene.train.frames)]
    train = ViewSet(frames, lambda i: replace(scene.train[i], frame=frames[i]))
    write_scene(replace(scene, train=train), tmp_path / "scene", tmp_path / "truth", {})
    model = read_model(tmp_path / "scene")
    lenses = dict(zip(model.names, model.lenses, strict=True))
    for frame in frames:
        lens = lenses[f"{Path(frame.name).stem}.tiff"]
        assert np.allclose(lens.matrix(), frame.camera.K.numpy())


def test_images_of_one_name_are_refused(tmp_path):
    scene = Synthetic(scene="cooling", size="tiny").scene
    frames = [replace(frame, name=f"{'ab'[i % 2]}/{i // 2}.png") for i, frame in enumerate(scene.train.frames)]
    train = ViewSet(frames, lambda i: replace(scene.train[i], frame=frames[i]))
    with pytest.raises(SceneError, match="such as a/0.png and b/0.png have one name in several folders"):
        write_scene(replace(scene, train=train), tmp_path / "scene", tmp_path / "truth", {})
    assert not list(tmp_path.iterdir())
