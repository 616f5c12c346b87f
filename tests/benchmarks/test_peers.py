"""heatsplat beside another program: what both are given, what is scored, and the study with a program that only pretends."""

import csv
import json
import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import heatsplat
from benchmarks.peers import rasterisers, study, training
from benchmarks.peers.report import equal_psnr, seconds_to
from benchmarks.peers.scenes import PointScene, shared
from heatsplat.contracts import Camera, SceneError, ViewSet
from heatsplat.datamodules.formats.colmap import read_model
from heatsplat.datamodules.formats.images import read_image
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.geometry.neighbours import neighbour_distances
from heatsplat.io.ply import write_splats
from heatsplat.metrics.psnr import psnr

ROOT = Path(__file__).resolve().parents[2]
TILES = "benchmarks.renderer.peers:render_torch_tiles"
PRETENDER = """#!{python} -S
import json, os, shutil, sys
with open({notes!r}, "a") as file:
    given = dict(arguments=sys.argv[1:], threads=os.environ.get("OMP_NUM_THREADS"), waits=os.environ.get("OMP_WAIT_POLICY"))
    file.write(json.dumps(given | dict(cores=len(os.sched_getaffinity(0)))) + "\\n")
for step in range(1, int(sys.argv[sys.argv.index("-n") + 1]) + 1):
    print(f"Step {{step}}: 0.1 [0%]", flush=True)
shutil.copy({ply!r}, sys.argv[sys.argv.index("-o") + 1])
"""


@pytest.fixture(scope="module")
def garden(tmp_path_factory):
    """A made garden of a few points, as its data module."""
    generator = np.random.default_rng(0)
    poses = np.tile(np.eye(4, dtype=np.float32), (3, 1, 1))
    for pose, angle in zip(poses, (0.0, 0.4, 0.8), strict=True):
        pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        pose[2, 3] = 4
    file = tmp_path_factory.mktemp("garden") / "points.npz"
    np.savez(
        file,
        means3d=generator.uniform(-1, 1, (300, 3)).astype(np.float32),
        colors=generator.integers(0, 255, (300, 3), dtype=np.uint8),
        viewmats=poses,
        Ks=np.tile(np.array([[90, 0, 45], [0, 90, 35], [0, 0, 1]], np.float32), (3, 1, 1)),
        width=80,
        height=60,
    )
    return PointScene(str(file), views=9, downscale=2, count=100)


@pytest.fixture(scope="module")
def heated():
    return Synthetic(scene="static", size="tiny")


# ---- what both are given ----


def test_a_peer_gets_the_training_views_alone_and_heatsplat_all(garden, tmp_path):
    scene = shared(garden.scene, tmp_path)
    held_out = (scene.folder / "test.txt").read_text().split()
    everything, training_views = read_model(scene.folder), read_model(scene.peer_folder)
    assert len(everything.names) == 9 and len(held_out) == len(scene.images) == 2
    assert set(training_views.names) == set(everything.names) - set(held_out)
    for name, viewmat in zip(training_views.names, training_views.viewmats, strict=True):
        np.testing.assert_allclose(viewmat, everything.viewmats[everything.names.index(name)], atol=1e-12)
        picture = read_image(scene.peer_folder / "images" / name)
        np.testing.assert_array_equal(picture, read_image(scene.folder / "images" / name))
    for model in (everything, training_views):
        np.testing.assert_allclose(np.sort(model.points, 0), np.sort(scene.points.numpy(), 0), atol=1e-6)


def test_pictures_hold_the_views_and_grey_ones_have_one_channel(garden, heated, tmp_path):
    for data, channels in ((garden, 3), (heated, 1)):
        scene = shared(data.scene, tmp_path / str(channels))
        assert scene.modality == ("rgb" if channels == 3 else "thermal")
        for image, view in zip(scene.images, data.scene.test, strict=True):
            assert image.shape[-1] == channels
            assert (image - view.image(scene.modality)).abs().max() <= 0.5 / 255 + 1e-6


def test_cameras_of_a_made_garden_look_at_it_from_their_centre(garden):
    for view in garden.scene.train:
        camera = view.camera
        assert (camera.width, camera.height) == (40, 30) and camera.K[0, 2] == 20 and camera.K[0, 0] == 45
        assert view.rgb.max() > 0.2


def test_an_image_off_its_centre_and_a_mask_are_refused(garden, tmp_path):
    def with_first(change):
        views = garden.scene.train
        return replace(garden.scene, train=ViewSet(views.frames, lambda i: change(views[i])))

    def shifted(view):
        K = view.camera.K.clone()
        K[0, 2] += 1.5
        camera = Camera(view.camera.viewmat, K, view.camera.width, view.camera.height)
        return replace(view, frame=replace(view.frame, camera=camera))

    with pytest.raises(SceneError, match=r"1\.50 pixels off"):
        shared(with_first(shifted), tmp_path)
    with pytest.raises(SceneError, match="has a mask"):
        shared(with_first(lambda view: replace(view, mask=torch.ones(30, 40, dtype=torch.bool))), tmp_path)


def test_points_that_are_not_there_are_named():
    with pytest.raises(SceneError, match=r"no_such\.npz.*study\.scenes"):
        _ = PointScene("no_such.npz").scene


# ---- what is scored ----


def splats_of(scene, path, shift=0.0):
    """A PLY file of what a made garden was drawn from; ``shift`` is added to its colours."""
    stored = np.load(scene.file)
    size = neighbour_distances(torch.from_numpy(stored["means3d"])).square().mean(1).sqrt()
    size = size.clamp(max=size.median())
    count = len(size)
    write_splats(
        path,
        stored["means3d"],
        size.log()[:, None].expand(-1, 3),
        np.tile([1.0, 0, 0, 0], (count, 1)),
        np.full(count, math.log(0.9 / 0.1)),
        stored["colors"] / 255 + shift,
        sh_rest=np.zeros((count, 3, 3)),
    )
    return path


def test_a_file_of_the_true_splats_scores_as_well_as_8_bits_allow(garden, tmp_path):
    scene = shared(garden.scene, tmp_path)
    good, count = training.score(training.Trained(splats_of(garden, tmp_path / "true.ply"), 0.0, 0.0), scene)
    worse, _ = training.score(training.Trained(splats_of(garden, tmp_path / "off.ply", shift=0.05), 0.0, 0.0), scene)
    assert count == 300 and good > 55 and 20 < worse < 45


def test_splats_are_scored_with_the_blur_that_they_were_trained_with(garden, tmp_path, monkeypatch):
    """Thin ones, whose images depend on it."""

    def train_here(command, *_):
        heatsplat.train(heatsplat.compose([*command[2:], "init.scale=0.1"]), tmp_path / "run")
        return 1.0

    monkeypatch.setattr(training, "_run", train_here)
    scene = shared(garden.scene, tmp_path)
    recipe = ["method=3dgs", "thermal.modality=rgb", "thermal.channels=3", "doctor=false"]
    done = training.train_heatsplat("train.py", scene, recipe, 3, 1, tmp_path / "run")
    found, _ = training.score(done, scene)
    trained = heatsplat.load(tmp_path / "run" / "checkpoints" / "last.ckpt")
    frames = trained.scene.test.frames
    own = np.mean(
        [psnr(trained.module.predict(frame), image) for frame, image in zip(frames, scene.images, strict=True)]
    )
    assert found == pytest.approx(own, abs=0.01)
    wider, _ = training.score(replace(done, blur={}), scene)
    assert abs(wider - own) > 0.1


# ---- equal PSNR ----


def test_seconds_to_a_psnr_lie_on_a_line_in_their_logarithm():
    points = [(16.0, 24.0), (1.0, 20.0), (4.0, 22.0), (8.0, 21.0)]  # the third is longer and worse: left out
    assert seconds_to(points, 21.0) == (pytest.approx(2.0), False)
    assert seconds_to(points, 23.0) == (pytest.approx(8.0), False)
    assert seconds_to(points, 24.0) == (pytest.approx(16.0), False)
    assert seconds_to(points, 19.0) == (1.0, True)
    assert seconds_to(points, 24.1) == (None, False)


def test_ratios_are_of_one_scene_and_one_number_of_threads():
    def made(program, threads, psnr, seconds):
        row = {"scene": "a", "threads": threads, "program": program, "peer": program == "theirs", "steps": 1}
        return row | {"psnr": psnr, "training_s": seconds, "process_s": 2 * seconds}

    runs = [made("theirs", 1, 22.0, 100.0), made("theirs", 2, 22.0, 50.0)]
    runs += [made("ours", 1, 22.0, 10.0), made("ours", 2, 25.0, 2.0)]
    one, two = equal_psnr(runs)
    assert (one["ratio_training_s"], one["least_training_s"]) == (10.0, False)
    assert (two["ratio_process_s"], two["least_process_s"]) == (25.0, True)


# ---- rasterisers ----


def test_agreement_tells_a_gradient_that_is_off():
    def skewed(**arguments):
        return rasterisers.backend("cpu")(**arguments | {"means": arguments["means"] * 1.0}).mul(1.01)

    rows = rasterisers.agreement(rasterisers.made_up((200, 32, 24))(3), {"skewed": skewed})
    off, ours = rows
    assert off["means"] == pytest.approx(0.01, rel=0.1) and ours["means"] < 1e-4 and ours["image"] < 1e-4


# ---- the study, with a program that copies a file ----


@pytest.fixture
def pretender(garden, tmp_path):
    """Path of an executable that claims to train, and of the lines it leaves on how it was called."""
    notes, path = tmp_path / "notes.jsonl", tmp_path / "pretender"
    ply = splats_of(garden, tmp_path / "pretended.ply")
    path.write_text(PRETENDER.format(python=sys.executable, notes=str(notes), ply=str(ply)))
    path.chmod(0o755)
    return path, notes


SETTINGS = {"train": str(ROOT / "src/train.py"), "cases": [[50, 24, 16]], "rounds": 1}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="what cores a process has")
def test_the_study_runs_both_and_writes_their_tables(garden, pretender, tmp_path):
    program, notes = pretender
    recipe = ["method=3dgs", "thermal.modality=rgb", "thermal.channels=3", "thermal.sh_degree=1"]
    tables = study.run(
        tmp_path / "study",
        scenes={"garden": garden, "left out": None},
        opensplat=str(program),
        theirs={"theirs": {"steps": [3, 5], "options": ["--until", "{steps}"]}},
        ours={"rgb": {"SH 1": recipe}},
        steps=[8],
        threads=[1],
        rasteriser={"tiles": TILES},
        agreement=[100, 24, 16],
        **SETTINGS,
    )
    assert [(row["program"], row["steps"]) for row in tables["runs"]] == [
        ("theirs", 3),
        ("SH 1", 8),
        ("theirs", 5),
    ]
    peer, ours, _ = tables["runs"]
    assert peer["psnr"] > 55 and peer["gaussians"] == 300 and ours["psnr"] > 8 and ours["gaussians"] >= 90
    assert 0 < ours["training_s"] < ours["process_s"] and 0 < peer["training_s"] < peer["process_s"]
    called = [json.loads(line) for line in notes.read_text().splitlines()]
    assert [c["threads"] for c in called] == ["1", "1"] and all(c["cores"] == 1 and c["waits"] is None for c in called)
    assert called[0]["arguments"][0].endswith("garden/training") and called[0]["arguments"][-2:] == ["--until", "3"]
    assert len(tables["equal"]) == 2 and tables["equal"][0]["training_s"] is None  # eight steps do not get there
    assert [row["scene"] for row in tables["rasterisers"]] == ["garden", "made up, 50"]
    assert {row["renderer"] for row in tables["agreement"]} == {"tiles", "heatsplat"}
    text = (tmp_path / "study" / "peers.md").read_text()
    assert text.count("| garden |") == 6 and "nan" not in text
    for name, rows in tables.items():
        with open(tmp_path / "study" / f"{name}.csv", newline="") as file:
            assert len(list(csv.DictReader(file))) == len(rows)


def test_a_program_that_fails_is_quoted_and_one_that_is_not_there_named(garden, tmp_path):
    scene = shared(garden.scene, tmp_path)
    broken = tmp_path / "broken"
    broken.write_text(f"#!{sys.executable} -S\nraise SystemExit('no such thing')\n")
    broken.chmod(0o755)
    with pytest.raises(SceneError, match="no such thing"):
        training.train_opensplat(str(broken), scene, [], 3, 1, tmp_path / "run")
    with pytest.raises(SceneError, match="missing cannot be started"):
        training.train_opensplat(str(tmp_path / "missing"), scene, [], 3, 1, tmp_path / "run")
    broken.write_text(f"#!{sys.executable} -S\nprint('Step 1: done')\n")
    with pytest.raises(SceneError, match="trained 1 steps and wrote no file"):
        training.train_opensplat(str(broken), scene, [], 3, 1, tmp_path / "run")


def test_nothing_to_compare_with_is_an_error(tmp_path):
    with pytest.raises(SceneError, match=r"study\.opensplat="):
        study.run(
            tmp_path,
            scenes={},
            opensplat=None,
            theirs={},
            ours={},
            steps=[],
            threads=[1],
            rasteriser={},
            agreement=[9, 8, 8],
            **SETTINGS,
        )


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"rounds": 0}, "study.rounds must be a whole number, 1 or more, got 0"),
        ({"threads": []}, r"study.threads=\[\] has nothing in it"),
        ({"steps": ["long"]}, "study.steps must be a whole number, 1 or more, got long"),
        ({"opensplat": "/nonexistent"}, "study.opensplat=/nonexistent is no program: give the path of its executable"),
        ({"rasteriser": {"mine": "module"}}, "a renderer is given as module:function, got module"),
        ({"rasteriser": {"mine": "math:nope"}}, "a renderer is given as module:function, got math:nope"),
    ],
)
def test_what_is_wrong_is_said_before_scenes_are_written(wrong, message, garden, tmp_path):
    options = {
        "opensplat": None,
        "theirs": {},
        "ours": {},
        "steps": [1],
        "threads": [1],
        "rasteriser": {"tiles": TILES},
    }
    with pytest.raises(SceneError, match=message):
        study.run(tmp_path, scenes={"garden": garden}, agreement=[9, 8, 8], **SETTINGS | options | wrong)
    assert list(tmp_path.iterdir()) == []
