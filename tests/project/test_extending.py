"""docs/extending.md, followed literally in a copy of the repository."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from commands import succeeds

import heatsplat

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "docs" / "extending.md").read_text()
FILES = re.findall(r"^`([\w./]+)`\n\n```\w+\n(.*?)^```", TEXT, re.M | re.S)
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


def run(copy: Path, command: str) -> str:
    size = [] if "data=" in command else ["data.size=tiny"]
    shutil.rmtree(copy / "run", ignore_errors=True)
    return succeeds([*command.split()[1:], *size, f"hydra.run.dir={copy}/run"], copy)


def test_the_page_adds_one_of_each_kind():
    kinds = {path.rsplit("/", 1)[0] for path, _ in FILES}
    assert kinds >= {"datamodules", "conf/data"}
    packages = ("thermal", "sensors", "density", "losses", "renderers", "callbacks", "metrics")
    assert kinds >= {f"src/heatsplat/{package}" for package in packages}
    assert not any((ROOT / path).exists() for path, _ in FILES), "the page must add files, not replace them"


@pytest.mark.parametrize("command", COMMANDS)
def test_its_commands_run(command, copy):
    assert "psnr" in run(copy, command)


def test_what_callbacks_of_the_page_find_stands_in_the_results(copy):
    def results(callbacks):
        run(copy, f"python src/train.py method=3dgs callbacks={callbacks} debug=fast")
        return json.loads((copy / "run" / "metrics.json").read_text())

    assert 0 < results("warmest")["data"]["warmest_c"] < 100
    scored = results("rmse")
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


def test_its_data_set_loads(copy, tmp_path):
    from heatsplat.datamodules.synthetic import Synthetic

    scene = Synthetic(scene="cooling", size="tiny").scene
    camera = scene.train.frames[0].camera
    frames = sorted(
        (frame.time_s, views[i]) for views in (scene.train, scene.test) for i, frame in enumerate(views.frames)
    )
    start = frames[0][0]
    for time_s, view in frames:
        celsius = scene.thermal_range.to_celsius(view.thermal[..., 0]).numpy()
        np.save(tmp_path / f"{time_s - start:.3f}.npy", celsius)
    np.savez(
        tmp_path / "cameras.npz",
        viewmats=np.stack([view.camera.viewmat.numpy() for _, view in frames]),
        K=camera.K.numpy(),
        points=scene.points.numpy(),
    )
    command = (
        f"python src/train.py method=linear_drift data=npy_folder data.root={tmp_path} debug=fast data.downscale=1"
    )
    assert "mae_c" in run(copy, command)
