"""CostMeter: what is timed and what is not, memory, and going on after a resume."""

import time
from dataclasses import replace

import numpy as np
import pytest
import pytorch_lightning as pl
import torch
from commands import succeeds
from fake_run import FakeModule, evaluate, fit, trainer, wall
from pytorch_lightning.callbacks import ModelCheckpoint

from heatsplat.callbacks import timing
from heatsplat.callbacks.timing import CLEAR, CostMeter


def work(seconds: float) -> None:
    """Keeps the processor busy for so long, by its own clock."""
    end = time.process_time() + seconds
    while time.process_time() < end:
        pass


class Slow(FakeModule):
    """Steps wait for 10 ms and work for 4, the first one 300 and 200 (a compiler at work); a validation view waits for 100
    and works for 50, a test view waits for 20."""

    def training_step(self, view, batch_idx):
        time.sleep(0.3 if self.global_step == 0 else 0.01)
        work(0.2 if self.global_step == 0 else 0.004)
        return super().training_step(view, batch_idx)

    def validation_step(self, view, batch_idx):
        time.sleep(0.1)
        work(0.05)
        return super().validation_step(view, batch_idx)

    def predict(self, frame):
        if self.trainer.testing:
            time.sleep(0.02)
        return super().predict(frame)


def test_compiling_and_evaluation_are_not_training(tmp_path):
    module = Slow(wall(), tmp_path)
    job = trainer(tmp_path, [CostMeter(fps_views=2, fps_repeats=3)], steps=20, every=10)
    start = time.perf_counter()
    fit(module, job)
    elapsed = time.perf_counter() - start
    cost = dict(module.results.cost)
    assert cost["warmup_seconds"] >= 0.3
    assert cost["evaluation_seconds"] >= 6 * 0.1
    assert 17 * 0.01 <= cost["train_seconds"] <= elapsed - 0.9
    assert 17 * 0.004 <= cost["cpu_seconds"] <= cost["train_seconds"] - 17 * 0.01  # waiting is not work
    assert cost["cpu_seconds"] <= 17 * 0.004 + 0.2  # nor are the first step and the validations training
    assert cost["steps_per_second"] == pytest.approx(17 / cost["train_seconds"])
    assert cost["wall_seconds"] <= elapsed
    assert "render_fps" not in cost
    evaluate(module, job)
    assert 10 < module.results.cost["render_fps"] <= 50
    assert module.results.cost["train_seconds"] == cost["train_seconds"]


class Aside(pl.Callback):
    """Waits 50 ms after two of the steps, and once more when training has ended, which counts as something else."""

    def __init__(self, meter):
        self.meter = meter

    def wait(self, module):
        with self.meter.apart("watching", module):
            time.sleep(0.05)
            work(0.02)

    def on_train_batch_end(self, run, module, *_):
        if run.global_step in (1, 10):  # while it warms up, and later
            self.wait(module)

    def on_train_end(self, run, module):
        self.wait(module)


def test_what_is_kept_apart_is_no_training_and_the_phase_goes_on_after_it(tmp_path):
    module, meter = Slow(wall(), tmp_path), CostMeter()
    fit(module, trainer(tmp_path, [meter, Aside(meter)], steps=20, every=20))
    cost = module.results.cost
    assert 3 * 0.07 <= cost["watching_seconds"] <= 3 * 0.07 + 0.15
    assert cost["train_seconds"] >= 17 * 0.01 and meter.steps == 17
    assert cost["cpu_seconds"] <= cost["train_seconds"] - 17 * 0.009
    parts = ("train_seconds", "warmup_seconds", "evaluation_seconds", "watching_seconds")
    assert cost["wall_seconds"] == pytest.approx(sum(cost[name] for name in parts))
    assert cost["steps_per_second"] == pytest.approx(17 / cost["train_seconds"])
    again = CostMeter()
    again.load_state_dict(meter.state_dict())
    assert again.seconds == meter.seconds


@pytest.mark.parametrize(("views", "timed"), [(2, [0, 1]), (3, [0, 1, 2]), (6, [0, 1, 3, 4])])
def test_the_frame_rate_is_that_of_views_all_over_the_test_each_once(tmp_path, monkeypatch, views, timed):
    module = Slow(wall(), tmp_path)
    module.scene = replace(module.scene, test=module.scene.train.subset([*range(views)]))
    meter, seen = CostMeter(), []
    monkeypatch.setattr(meter, "_render_seconds", lambda _, frames: seen.extend(frames) or [1.0])
    meter.on_test_epoch_end(None, module)
    assert [frame.frame_id for frame in seen] == [module.scene.test.frames[i].frame_id for i in timed]


def test_a_resumed_run_goes_on_counting(tmp_path):
    save = ModelCheckpoint(tmp_path, filename="{step}", every_n_train_steps=8, save_top_k=-1)
    module = Slow(wall(), tmp_path)
    fit(module, trainer(tmp_path, [CostMeter(), save], steps=8, every=4))
    stored = torch.load(tmp_path / "step=8.ckpt", weights_only=True)["callbacks"]["CostMeter"]
    stored, stored_cpu = stored["seconds"], stored["cpu_seconds"]
    assert 5 * 0.01 <= stored["train"] <= module.results.cost["train_seconds"]
    again = Slow(wall(), tmp_path)
    fit(again, trainer(tmp_path, [CostMeter()], steps=16, every=4), ckpt=tmp_path / "step=8.ckpt")
    cost = again.results.cost
    assert cost["train_seconds"] >= stored["train"] + 5 * 0.01
    assert stored_cpu >= 5 * 0.004 and cost["cpu_seconds"] >= stored_cpu + 5 * 0.004
    assert cost["steps_per_second"] == pytest.approx((8 - 3 + 8 - 3) / cost["train_seconds"])
    assert cost["warmup_seconds"] >= stored["warmup"] + 3 * 0.01
    # 3 views at steps 4, 12 and 16; the one at step 8 came after the checkpoint
    assert cost["evaluation_seconds"] >= 0.9


def test_what_was_chosen_before_training_has_its_own_time(tmp_path):
    for config, seconds in (({}, 0.0), ({"choosing_seconds": 7.5}, 7.5)):
        module = FakeModule(wall(), tmp_path, config)
        fit(module, trainer(tmp_path, [CostMeter()], steps=5, every=5))
        assert module.results.cost["choosing_seconds"] == seconds
        assert module.results.cost["wall_seconds"] < 7.5


def test_runs_without_timed_steps_say_so(tmp_path):
    module = FakeModule(wall(), tmp_path)
    job = trainer(tmp_path, [CostMeter()], steps=3, every=3)
    fit(module, job)
    assert module.results.cost["train_seconds"] is None
    assert "not longer than its 3 steps of warm-up" in module.results.reasons["cost.train_seconds"]

    module = FakeModule(wall(), tmp_path)
    evaluate(module, trainer(tmp_path, [CostMeter()]))
    assert module.results.cost["train_seconds"] is None
    assert "trained nothing" in module.results.reasons["cost.steps_per_second"]
    assert module.results.cost["gaussians"] == 300


def test_a_system_that_tells_no_memory_trains_all_the_same(tmp_path, monkeypatch):
    """As Windows, which has no module resource."""
    monkeypatch.setattr(timing, "resource", None)
    monkeypatch.setattr(timing, "STATUS", tmp_path / "none")
    module = FakeModule(wall(), tmp_path)
    fit(module, trainer(tmp_path, [CostMeter(every=2)], steps=6, every=3))
    content = module.results.as_json()
    assert content["cost"]["peak_memory_mb"] is None and content["cost"]["train_seconds"] > 0
    assert "does not tell" in content["reasons"]["cost.peak_memory_mb"]
    script = tmp_path / "elsewhere.py"  # in a folder of its own, it loads heatsplat anew
    script.write_text("import sys; sys.modules['resource'] = None; import heatsplat.callbacks.timing")
    succeeds([script])


def test_peak_memory_is_that_of_this_run(tmp_path):
    class Hungry(FakeModule):
        def training_step(self, view, batch_idx):
            np.ones(60_000_000).sum()  # 480 MB, given back at once
            return super().training_step(view, batch_idx)

    def peak(kind):
        module = kind(wall(), tmp_path)
        fit(module, trainer(tmp_path, [CostMeter()], steps=5, every=5))
        return module.results.cost["peak_memory_mb"]

    before, hungry, after = peak(FakeModule), peak(Hungry), peak(FakeModule)
    assert hungry > before + 400
    if CLEAR.exists():
        assert after < hungry - 300  # a sweep's next run does not inherit the peak
