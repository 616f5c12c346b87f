"""docs/extending.md, followed literally in a copy of the repository."""

import itertools
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from commands import in_turn
from omegaconf import OmegaConf
from running import TINY

import heatsplat

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "extending.md").read_text()
FILES = re.findall(r"^`([\w./]+)`\n\n```\w+\n(.*?)^```", TEXT, re.M | re.S)
OWN_DATA = "python src/train.py method=linear_drift data=npy_folder data.root={} debug=fast data.downscale=1"
COMMANDS = [line for block in re.findall(r"^```sh\n(.*?)^```", TEXT, re.M | re.S) for line in block.splitlines()]


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Path:
    """A copy of the sources with the files of the page written into it."""
    folder = tmp_path_factory.mktemp("extended")
    for name in ("src", "conf", "datamodules"):
        shutil.copytree(ROOT / name, folder / name, ignore=shutil.ignore_patterns("*.egg-info"))
    for path, content in FILES:
        (folder / path).write_text(content)
    return folder


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """A folder of images as the page's own data set reads them."""
    from heatsplat.datamodules.synthetic import Synthetic

    folder = tmp_path_factory.mktemp("recording")
    scene = Synthetic(scene="cooling", size="tiny").scene
    camera = scene.train.frames[0].camera
    frames = sorted(
        (frame.time_s, views[i]) for views in (scene.train, scene.test) for i, frame in enumerate(views.frames)
    )
    start = frames[0][0]
    for time_s, view in frames:
        celsius = scene.thermal_range.to_celsius(view.thermal[..., 0]).numpy()
        np.save(folder / f"{time_s - start:.3f}.npy", celsius)
    np.savez(
        folder / "cameras.npz",
        viewmats=np.stack([view.camera.viewmat.numpy() for _, view in frames]),
        K=camera.K.numpy(),
        points=scene.points.numpy(),
    )
    return folder


@pytest.fixture(scope="module")
def results(copy, recording) -> Callable[[str], dict]:
    """Of a command the results of its run, of which the files are left out that no test looks at."""
    tiny, *quick = TINY
    quick += ["max_steps=30", "trainer.val_check_interval=30", "doctor=false", "callbacks.costs.fps_repeats=1"]
    quick += ["callbacks.dashboard=null", "callbacks.attributes=null"]
    given = {command: [*command.split()[1:], tiny] for command in COMMANDS}
    given[OWN_DATA] = OWN_DATA.format(recording).split()[1:]
    runs = {command: copy / "runs" / f"{number}" for number, command in enumerate(given)}
    words = [[*given[command], *quick, f"hydra.run.dir={run}"] for command, run in runs.items()]
    ended = dict(zip(given, in_turn(words, copy), strict=True))

    def of(command):
        assert ended[command].returncode == 0, ended[command].output
        return json.loads((runs[command] / "metrics.json").read_text())

    return of


def test_the_page_adds_one_of_each_kind():
    kinds = {path.rsplit("/", 1)[0] for path, _ in FILES}
    assert kinds >= {"datamodules", "conf/data"}
    packages = ("thermal", "sensors", "density", "losses", "renderers", "callbacks", "metrics")
    assert kinds >= {f"src/heatsplat/{package}" for package in packages}
    assert not any((ROOT / path).exists() for path, _ in FILES), "the page must add files, not replace them"


@pytest.mark.parametrize("command", COMMANDS)
def test_its_commands_run(command, results):
    assert results(command)["test"]["psnr"] > 0


def test_what_callbacks_of_the_page_find_stands_in_the_results(results):
    warmest, scored = (
        results(f"python src/train.py method=3dgs callbacks={name} debug=fast") for name in ("warmest", "rmse")
    )
    assert 0 < warmest["data"]["warmest_c"] < 100
    assert scored["test"]["rmse_c"] >= scored["test"]["mae_c"] > 0 and "root" in scored["definitions"]["rmse_c"]


def test_parts_outside_of_the_repository_are_trained_and_loaded(tmp_path, monkeypatch):
    content = dict(FILES)
    (tmp_path / "conf" / "thermal").mkdir(parents=True)
    (tmp_path / "my_heat.py").write_text(content["src/heatsplat/thermal/linear_drift.py"])
    settings = content["conf/thermal/linear_drift.yaml"].replace("heatsplat.thermal.linear_drift", "my_heat")
    (tmp_path / "conf" / "thermal" / "my_drift.yaml").write_text(settings)
    monkeypatch.syspath_prepend(tmp_path)
    quick = ["data.scene=cooling", "data.size=tiny", "max_steps=3", "threads=1", "test=false", "doctor=false"]
    config = heatsplat.compose([f"hydra.searchpath=[{tmp_path}/conf]", "method=3dgs", "thermal=my_drift", *quick])
    heatsplat.train(config, tmp_path / "run")
    trained = heatsplat.load(tmp_path / "run" / "checkpoints" / "last.ckpt", trust=["my_heat.LinearDrift"])
    assert type(trained.module.thermal).__name__ == "LinearDrift"


def test_its_ablation_is_a_sweep_of_rows_that_differ(tmp_path):
    content = dict(FILES)
    for name in ("thermal/linear_drift", "method/linear_drift", "ablation/linear_drift_parts"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / f"{name}.yaml").write_text(content[f"conf/{name}.yaml"])
    written = OmegaConf.load(tmp_path / "ablation" / "linear_drift_parts.yaml").hydra
    assert written.mode == "MULTIRUN" and written.sweeper.of == "linear_drift"
    given = [f"hydra.searchpath=[{tmp_path}]", "ablation=linear_drift_parts"]
    models = [heatsplat.compose([*given, *row.set])["thermal"] for row in written.sweeper.rows.values()]
    assert len(models) == 3 and all(one != other for one, other in itertools.combinations(models, 2))


def test_its_data_set_loads(results):
    assert results(OWN_DATA)["test"]["mae_c"] > 0
