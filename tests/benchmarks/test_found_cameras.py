"""The study of found cameras: what it hands to prepare.py and train.py, and what it says of either."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from benchmarks import found_cameras
from benchmarks.found_cameras import TABLE_FILE, prepared
from heatsplat.composition import CONF
from heatsplat.contracts import SceneError
from heatsplat.datamodules.formats.colmap import read_model, write_model
from heatsplat.datamodules.synthetic_scene.film import Size, film
from heatsplat.datamodules.synthetic_scene.presets import PRESETS
from heatsplat.datamodules.synthetic_scene.scene import Scene
from heatsplat.io.results import RunResults
from heatsplat.studies.child_runs import OtherSettingsError

LENS = ("PINHOLE", (30.0, 30.0, 16.0, 12.0), 32, 24)
CASE = {"scene": "cooling", "width": 32, "height": 24, "frames": 5, "dead_pixels": 3}
TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def in_another_world(viewmat: np.ndarray) -> np.ndarray:
    """World to camera where the world is half as large, turned and elsewhere: x -> 0.5 TURN x + (1, 2, 3)."""
    moved = np.eye(4)
    moved[:3, :3] = viewmat[:3, :3] @ TURN.T
    moved[:3, 3] = 0.5 * viewmat[:3, 3] - moved[:3, :3] @ [1.0, 2.0, 3.0]
    return moved


@pytest.mark.parametrize(
    ("seeds", "scores"),
    [((0,), "31.0 | 0.100 | 1,200"), ((0, 2), "32.0 ± 1.4 | 0.100 ± 0.000 | 1,300")],
    ids=["one seed", "two"],
)
def test_cameras_are_compared_and_both_trained_with_the_same_points(tmp_path, monkeypatch, seeds, scores):
    true = film(Scene(PRESETS["cooling"]), Size(32, 24, 5, 16)).viewmats
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    asked, trained_on = [], []

    def pretend(prepare, settings, target: Path):
        asked.append(settings)
        (target / "images").mkdir(parents=True)
        for frame in range(5):
            (target / "images" / f"frame_{frame:04d}_T.tiff").touch()
        poses = {f"frame_{frame:04d}_T.tiff": in_another_world(true[frame]) for frame in (0, 1, 3, 4)}
        model = poses, [LENS], 0.5 * points @ TURN.T + [1.0, 2.0, 3.0], np.zeros((20, 3))
        write_model(target / "sparse" / "0", *model)
        return {"cpu_s": 12.3, "mib": 456.0}

    def train(place, program, overrides, study):
        trained_on.append(overrides)
        seed = int(overrides[-2].removeprefix("seed="))
        results = RunResults()
        for section, name, value in (
            ("test", "psnr", 31.0 + seed),
            ("test", "mae_c", 0.1),
            ("cost", "gaussians", 1200 + 100 * seed),
            ("cost", "cpu_seconds", 7.0),
        ):
            results.put(section, name, value)
        return results

    monkeypatch.setattr(found_cameras, "prepared", pretend)
    monkeypatch.setattr(found_cameras, "train_or_read", train)
    case = {"room": CASE | {"settings": ["poses.clip=2"]}}
    found_cameras.run(tmp_path, "prepare.py", "train.py", case, ["max_steps=3"], 1, seeds)
    table = (tmp_path / TABLE_FILE).read_text()
    assert "| room | 4 of 5 | 0.00° (0.00°) | 0.00 % (0.00 %) | 12 | 456 |" in table
    assert f"| room | found | {scores} | 7 |" in table and f"| room | true | {scores} " in table
    given = read_model(tmp_path / "room" / "model")
    np.testing.assert_allclose(np.stack(given.viewmats), true[[0, 1, 3, 4]], atol=1e-9)
    np.testing.assert_allclose(np.sort(given.points, 0), np.sort(points, 0), atol=1e-6)
    assert len(list((tmp_path / "room" / "files" / "thermal").iterdir())) == 5
    assert (
        asked[0] == [f"source={tmp_path / 'room' / 'files' / 'thermal'}", "poses.clip=2"] and "poses=given" in asked[1]
    )
    assert [lines[-2:] for lines in trained_on] == [
        [f"seed={seed}", f"data.root={tmp_path / 'room' / kind}"] for kind in ("found", "true") for seed in seeds
    ]


def test_what_a_command_takes_is_kept_and_what_it_says_where_it_fails(tmp_path):
    works = tmp_path / "works.py"
    works.write_text("import sys; sum(range(10**7)); print(sys.argv)")
    spent = prepared(str(works), ["a=1"], tmp_path / "one")
    assert 0.05 < spent["cpu_s"] < 60.0 and 4.0 < spent["mib"] < 60.0  # not those of the tests
    works.write_text("raise SystemExit('no cameras')")
    assert prepared(str(works), ["a=1"], tmp_path / "one") == spent
    with pytest.raises(OtherSettingsError, match=r"one was made with other settings \(a=1, a=2\)"):
        prepared(str(works), ["a=2"], tmp_path / "one")
    with pytest.raises(SceneError, match=f"(?s){Path(sys.executable).name}.*target=.*no cameras"):
        prepared(str(works), ["a=1"], tmp_path / "two")


def test_a_study_that_is_stopped_leaves_nothing_running(tmp_path, monkeypatch):
    started = []

    def stop(process):
        started.append(process)
        raise KeyboardInterrupt

    monkeypatch.setattr(found_cameras, "_peak_mib", stop)
    (tmp_path / "prepare.py").write_text("import time; time.sleep(60)")
    with pytest.raises(KeyboardInterrupt):
        prepared(str(tmp_path / "prepare.py"), [], tmp_path / "one")
    with pytest.raises(ProcessLookupError):
        os.kill(started[0], 0)


def test_files_of_another_recording_are_refused(tmp_path):
    found_cameras._given(CASE, tmp_path)
    found_cameras._given(CASE | {"settings": ["poses.clip=2"]}, tmp_path)  # of prepare.py
    with pytest.raises(
        OtherSettingsError, match=r"files was made with other settings \(dead_pixels=3, dead_pixels=4\)"
    ):
        found_cameras._given(CASE | {"dead_pixels": 4}, tmp_path)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"cases": {}}, r"study.cases=\[\] has nothing in it"),
        ({"cases": {"room": CASE | {"scene": "nope"}}}, "study.cases.room.scene must be one of flight, .*got 'nope'"),
        ({"seeds": []}, r"study.seeds=\[\] has nothing in it"),
    ],
)
def test_what_is_wrong_is_said_before_anything_is_prepared(wrong, message, tmp_path, monkeypatch):
    monkeypatch.setattr(found_cameras, "prepared", lambda *_: pytest.fail("it ran"))
    options = {"cases": {"room": CASE}, "overrides": None} | wrong
    with pytest.raises(SceneError, match=message):
        found_cameras.run(tmp_path, "prepare.py", "train.py", **options)


def test_its_configuration_names_cases_that_there_are():
    cases = yaml.safe_load((Path(CONF) / "study" / "found_cameras.yaml").read_text())["cases"]
    assert len(cases) > 3 and all(case["scene"] in {*PRESETS, found_cameras.FLIGHT} for case in cases.values())
