"""A lean step is Lightning's own: the same hooks in the same order, the same bits; what asks for more gets Lightning's."""

import pytest
import pytorch_lightning as pl
import torch
from pytorch_lightning.loops.training_epoch_loop import _TrainingEpochLoop
from running import TINY
from test_runs import state_of

from heatsplat.composition import compose
from heatsplat.runs.run import begin
from heatsplat.training.loop import STEP_HOOKS, without_idle_hooks
from heatsplat.training.session import fit

SHORT = (*TINY, "method=etgs", "max_steps=4", "test=false", "logger=none")


class Recorder(pl.Callback):
    """The names of the hooks of each step, how many Lightning logged, and whether gains had a gradient that was written out."""

    def __init__(self) -> None:
        self.told, self.written, self.logged = [], [], []


def _recording(name):
    def hook(self, trainer, module, *_):
        self.told.append((name, trainer.global_step))
        if name == "on_before_optimizer_step":
            self.written.append(module.splats["source_gains"].grad is not None)
        if name == "on_train_batch_end":
            module.log("hooks", float(len(self.told)))
        if name == "on_train_batch_start":
            self.logged.append(trainer.callback_metrics.get("hooks"))

    return hook


for _name in STEP_HOOKS:
    setattr(Recorder, _name, _recording(_name))


def trained(output_dir, *overrides, lean=True, **limits):
    """A short run, and what a callback was told."""
    run, recorder = begin(compose([*SHORT, *overrides]), output_dir), Recorder()
    run.trainer.callbacks.append(without_idle_hooks(recorder))
    for name, value in limits.items():
        setattr(run.trainer, name, value)
    if not lean:
        loop = run.trainer.fit_loop.epoch_loop
        run.trainer.fit_loop.epoch_loop = _TrainingEpochLoop(run.trainer, loop.min_steps, loop.max_steps)
    fit(run.module, run.data, run.trainer, test=False)
    return state_of(run.module, run.trainer), recorder


@pytest.mark.parametrize("accumulate", [1, 2])
def test_hooks_and_bits_are_lightnings(tmp_path, accumulate):
    views = f"optim.accumulate={accumulate}", "optim.accumulate_from=0"
    found, told = trained(tmp_path / "lean", *views)
    expected, theirs = trained(tmp_path / "full", *views, lean=False)
    assert all(torch.equal(found[name], expected[name]) for name in expected)
    assert told.told == theirs.told
    assert told.logged == theirs.logged and told.logged[-1] > 0
    assert len({name for name, _ in told.told}) == len(STEP_HOOKS)
    assert told.written == [False] * (4 // accumulate)


def test_gradients_are_clipped_where_that_is_asked_for(tmp_path):
    still = "optim.eps=1.0", "thermal.source_penalty=0"
    plain, _ = trained(tmp_path / "plain", *still)
    clipped, told = trained(tmp_path / "clipped", *still, gradient_clip_val=1e-6)
    assert told.written == [True] * 4
    name = "source_gains.exp_avg"
    assert 0 < clipped[name].norm() < 1e-6 < plain[name].norm()
