"""A run that is killed at any moment and started again in its folder ends with the same weights and scores."""

import json
import os
import signal

import pytest
import pytorch_lightning as pl
import torch
from running import NO_PICTURES
from test_checkpoint_files import disk_of

from heatsplat import composition
from heatsplat.callbacks import report
from heatsplat.contracts import SceneError
from heatsplat.runs import lock, run
from heatsplat.runs.signals import stoppable
from heatsplat.training.checkpoints import load_checkpoint

SHORT = (
    "method=3dgs", "data.size=tiny", "data.frames=9", "data.downscale=4", "max_steps=8", "threads=1", "callbacks.images=null",
    "callbacks.probes=null", "callbacks.costs.fps_repeats=1", "callbacks.costs.warmup_steps=1", "callbacks.statistics=null",
    "callbacks.metrics.lpips_net=null", "trainer.val_check_interval=4", "callbacks.report.show=false",
    "callbacks.progress.enabled=false", "callbacks.viewer=null", "doctor=false", *NO_PICTURES,
)  # fmt: skip


class Killed(BaseException):
    """Ends a run as SIGKILL would, as far as files go."""


class KillAfter(pl.Callback):
    def __init__(self, step):
        self.step = step

    def on_train_batch_end(self, trainer, *_):
        if trainer.global_step == self.step:
            raise Killed


@pytest.fixture(scope="module", autouse=True)
def no_curves():
    """Nobody looks at the picture, which takes half of such a run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report, "draw_curves", lambda folder: None)
        yield


@pytest.fixture(scope="module")
def config():
    return composition.compose(SHORT) | {"logger": None}


def found_in(folder):
    weights = load_checkpoint(folder / "checkpoints" / "last.ckpt")["state_dict"]
    return weights, json.loads((folder / "metrics.json").read_text())["test"]


@pytest.fixture(scope="module")
def whole(config, tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    run.train(config, folder)
    return found_in(folder)


def check_goes_on(config, folder, whole):
    run.train(config, folder)
    weights, scores = found_in(folder)
    assert scores == whole[1]
    assert weights.keys() == whole[0].keys() and all(torch.equal(weights[name], whole[0][name]) for name in weights)
    assert (folder / "report.md").exists()


@pytest.mark.parametrize("step", (1, 7))  # before the first checkpoint, and between two
def test_killed_while_it_trains(config, whole, tmp_path, monkeypatch, step):
    with monkeypatch.context() as patch:
        patch.setattr(run, "build_callbacks", with_more(run.build_callbacks, KillAfter(step)))
        with pytest.raises(Killed):
            run.train(config, tmp_path)
    assert not (tmp_path / "metrics.json").exists()
    check_goes_on(config, tmp_path, whole)


def test_stopped_by_sigterm_while_it_trains(config, whole, tmp_path, monkeypatch):
    class Terminate(pl.Callback):
        def on_train_batch_end(self, trainer, *_):
            if trainer.global_step == 5:
                os.kill(os.getpid(), signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(run, "build_callbacks", with_more(run.build_callbacks, Terminate()))
        with pytest.raises(SystemExit) as stopped, stoppable():
            run.train(config, tmp_path)
    assert stopped.value.code == 130 and not (tmp_path / "metrics.json").exists()
    assert load_checkpoint(tmp_path / "checkpoints" / "last.ckpt")["global_step"] >= 5
    check_goes_on(config, tmp_path, whole)


def with_more(build, callback):
    return lambda callbacks, output_dir: [*build(callbacks, output_dir), callback]


# Files that a run writes as a whole, and which of them is cut off.
WRITES = ("step_000002.ckpt", "last.ckpt", "report.md", "metrics.json")


@pytest.mark.parametrize("name", WRITES)
def test_killed_while_it_writes(config, whole, tmp_path, monkeypatch, name):
    def cut(source, target):
        if os.path.basename(target) == name:
            os.truncate(source, os.path.getsize(source) // 2)
            os.link(source, f"{source}1")  # a process that is killed cleans nothing up
            raise Killed
        os.rename(source, target)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", cut)
        with pytest.raises(Killed):
            run.train(config, tmp_path)
    check_goes_on(config, tmp_path, whole)
    assert not list((tmp_path / "checkpoints").glob(".*"))


def test_a_disk_that_is_full_for_a_while(config, whole, tmp_path, monkeypatch):
    class Fill(pl.Callback):
        def on_train_batch_end(self, trainer, *_):
            if trainer.global_step == 5:
                self.disk = disk_of(2000)
                self.disk.__enter__()

    fill = Fill()
    with monkeypatch.context() as patch:
        patch.setattr(run, "build_callbacks", with_more(run.build_callbacks, fill))
        try:
            with pytest.raises(SceneError, match=r"checkpoint of step 6 .* could not be written .* make room"):
                run.train(config, tmp_path)
        finally:
            fill.disk.__exit__(None, None, None)
    assert load_checkpoint(tmp_path / "checkpoints" / "last.ckpt")["global_step"] == 4
    check_goes_on(config, tmp_path, whole)


def test_a_damaged_checkpoint_is_passed_over(config, whole, tmp_path, caplog):
    run.train({**config, "test": False}, tmp_path)
    for name in ("last.ckpt", "step_000008.ckpt", "step_000006.ckpt"):
        path = tmp_path / "checkpoints" / name
        data = bytearray(path.read_bytes())
        data[len(data) // 2 : len(data) // 2 + 64] = bytes(64)
        path.write_bytes(data)
    check_goes_on(config, tmp_path, whole)
    assert "checksum differs" in caplog.text


def test_a_second_process_in_the_folder_is_sent_away(config, tmp_path):
    with lock.locked(tmp_path), pytest.raises(SceneError, match="under way"):
        run.train(config, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [".lock"]
