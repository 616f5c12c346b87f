"""Whole runs on the tiny synthetic scene: they resume bit for bit, stop gracefully and refuse what does not fit."""

import json
import signal
import warnings

import pytest
import torch
from running import TINY, run

from heatsplat.contracts import SceneError
from heatsplat.runs.signals import stoppable
from heatsplat.training.checkpoints import load_checkpoint

SHORT = (
    *TINY,
    "max_steps=40",
    "density.start=5",
    "density.every=10",
    "density.stop=30",
    "trainer.val_check_interval=20",
)


def state_of(module, trainer) -> dict[str, torch.Tensor]:
    optimizer = trainer.optimizers[0]
    found = {name: value.clone() for name, value in module.state_dict().items()}
    for group in optimizer.param_groups:
        for key, value in optimizer.state[group["params"][0]].items():
            found[f"{group['name']}.{key}"] = torch.as_tensor(value).clone()
    return found


# After 16 steps between refinements, whose statistics a checkpoint holds, and after 38 within the tail that is averaged.
@pytest.mark.parametrize(("method", "step"), [("3dgs", 16), ("etgs", 16), ("etgs", 38)])
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(method, step, tmp_path):
    overrides = (*SHORT, f"method={method}", "test=false", f"callbacks.checkpoint.every_n_train_steps={step}")
    whole = state_of(*run(tmp_path / "whole", *overrides))
    half = tmp_path / "whole" / "checkpoints" / f"step_0000{step}.ckpt"
    resumed = state_of(*run(tmp_path / "resumed", *overrides, f"ckpt={half}"))
    assert whole.keys() == resumed.keys()
    different = [name for name in whole if not torch.equal(whole[name], resumed[name])]
    assert different == []
    assert len(whole["splats.raw.means"]) > 600  # density control was at work


def test_a_run_leaves_metrics_beside_their_cost(tmp_path):
    module, _ = run(tmp_path, *SHORT, "method=etgs")
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found["test"]["psnr"] > 5 and found["test"]["mae_c"] > 0
    scene = module.scene
    assert module.background.tolist() == [pytest.approx(scene.thermal_range.to_unit(scene.ambient_c))] != [0.0]
    assert found["cost"]["gaussians"] == len(module.splats)
    assert found["cost"]["train_seconds"] > 0 and found["cost"]["render_fps"] > 0
    assert found["effects"]["harmonic_source"]["frequencies"] > 0
    assert found["test"]["lpips"] is not None or "LPIPS" in found["reasons"]["test.lpips"]
    assert (tmp_path / "report.md").exists()


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGUSR2"])
def test_interruption_leaves_a_checkpoint_that_resumes(name, tmp_path, monkeypatch):
    import heatsplat.training.session as session

    steps, listen = [], session.StopOnInterrupt.on_train_batch_end

    def interrupt_at_seven(self, trainer, *rest):
        steps.append(trainer.global_step)
        if trainer.global_step == 7:
            signal.raise_signal(signal.Signals[name])
        listen(self, trainer, *rest)

    monkeypatch.setattr(session.StopOnInterrupt, "on_train_batch_end", interrupt_at_seven)
    brief = ("max_steps=12", "trainer.limit_val_batches=0", "callbacks.costs=null", "logger=none")
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as stopped, stoppable():
        run(tmp_path, *SHORT, *brief, "method=3dgs")
    assert stopped.value.code == 130 and signal.getsignal(signal.SIGTERM) == before
    last = tmp_path / "checkpoints" / "last.ckpt"
    assert load_checkpoint(last)["global_step"] == 7 == steps[-1]
    often = "callbacks.checkpoint.every_n_train_steps=5"  # to Lightning another callback
    with warnings.catch_warnings(record=True) as told:
        _, trainer = run(tmp_path / "on", *SHORT, *brief, "method=3dgs", "test=false", f"ckpt={last}", often)
    assert not [each for each in told if "callbacks used to create" in str(each.message)]
    assert trainer.global_step == 12


def test_a_checkpoint_of_another_method_is_refused(tmp_path):
    run(tmp_path / "etgs", *SHORT, "method=etgs", "test=false", "max_steps=2", "trainer.limit_val_batches=0")
    last = tmp_path / "etgs" / "checkpoints" / "last.ckpt"
    with pytest.raises(SceneError, match="method 'etgs', this run is method '3dgs'"):
        run(tmp_path / "3dgs", *SHORT, "method=3dgs", "data.scene=cooling", f"ckpt={last}")


def test_a_missing_checkpoint_is_named_with_those_that_exist(tmp_path):
    (tmp_path / "other.ckpt").touch()
    with pytest.raises(SceneError, match="other.ckpt"):
        load_checkpoint(tmp_path / "none.ckpt")
    with pytest.raises(SceneError, match="not a checkpoint that can be read"):
        load_checkpoint(tmp_path / "other.ckpt")


def test_a_method_that_needs_time_refuses_a_scene_without(tmp_path, monkeypatch):
    from dataclasses import replace

    from heatsplat.contracts import ViewSet
    from heatsplat.datamodules.synthetic import Synthetic

    def timeless(views: ViewSet) -> ViewSet:
        return ViewSet([replace(frame, time_s=None) for frame in views.frames], lambda i: views[i])

    loaded = Synthetic.load

    def without_time(self):
        scene = loaded(self)
        return replace(scene, train=timeless(scene.train), val=timeless(scene.val), test=timeless(scene.test))

    monkeypatch.setattr(Synthetic, "load", without_time)
    with pytest.raises(SceneError, match="NewtonHarmonic needs time, which scene 'cooling' does not have"):
        run(tmp_path, *SHORT, "method=etgs")


def test_penalties_inside_the_optimiser_are_logged_beside_the_loss_terms(tmp_path):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    ridge = ("thermal.penalty=ridge", "thermal.source_penalty=1e-5", "optim.averaged=0")
    module, _ = run(tmp_path, *SHORT, "method=etgs", *ridge, "test=false", "callbacks.statistics.every=40")
    events = EventAccumulator(str(tmp_path / "tb"))
    events.Reload()
    logged = events.Scalars("loss/penalty/source_gains")[-1]
    gains = module.splats["source_gains"].detach()
    assert logged.step == 40
    assert logged.value == pytest.approx(1e-5 * gains.square().sum().item() / len(gains), rel=1e-4)


def test_a_loss_that_is_absent_at_some_steps_is_refused_before_training(tmp_path):
    ramp = "{_target_:heatsplat.losses.schedules.linear,_partial_:true,start:0.5,end:0.5}"
    plain = "{_target_:heatsplat.losses.photometric.Photometric}"
    late = f"+loss.terms.late={{_target_:heatsplat.losses.compose.Weighted,term:{plain},schedule:{ramp}}}"
    with pytest.raises(ValueError, match="no term of the loss counts at step 0 of 0 to 3; .* late from 2 to 3"):
        run(tmp_path, "method=3dgs", *TINY, "max_steps=4", "loss.terms.photometric=null", late)
    assert not list(tmp_path.glob("checkpoints/*"))


def test_density_control_draws_anew_at_every_step(tmp_path, monkeypatch):
    from heatsplat.density.budget import Budget
    from heatsplat.training.rng import generator_for

    seeds = []
    monkeypatch.setattr(Budget, "refine", lambda self, cloud, step, extent, draw: seeds.append(draw.initial_seed()))
    short = ("density=budget", "method=3dgs", "test=false", "max_steps=3", "seed=5", "trainer.limit_val_batches=0")
    run(tmp_path, *SHORT, *short)
    assert seeds == [generator_for(5, step, "density").initial_seed() for step in range(3)] and len(set(seeds)) == 3


def test_no_validation_measures_opacities_that_were_just_reset(tmp_path):
    """Opacities fall after step 30 and need 10 refinements, of which there is one each step."""
    resets = ("density=adaptive", "density.start=0", "density.every=1", "density.stop=50", "density.reset_every=30")
    few = ("density.grad_threshold=9", "callbacks.statistics=null", "callbacks.dashboard=null", "logger=none")
    _, trainer = run(
        tmp_path, *SHORT, *resets, *few, "method=3dgs", "test=false", "trainer.val_check_interval=16", "max_steps=80"
    )
    steps = [int(line.split(",")[0]) for line in (tmp_path / "curve.csv").read_text().splitlines()[1:]]
    assert trainer.global_step == 80 and steps == [14, 28, 42, 56, 70, 80]


def test_a_run_whose_end_moved_ends_there_and_resumes_bit_for_bit(tmp_path, monkeypatch):
    from heatsplat.training.module import SplatTraining

    after_step = SplatTraining.on_train_batch_end

    def moving(self, *rest):
        if self.global_step == 20:
            self.schedule.end_at(20, 33.4)
        after_step(self, *rest)

    monkeypatch.setattr(SplatTraining, "on_train_batch_end", moving)
    checkpoints = "callbacks.checkpoint.every_n_train_steps=24"
    overrides = (*SHORT, "method=3dgs", "optim.length_power=0", "test=false", checkpoints)
    whole, trainer = run(tmp_path / "whole", *overrides)
    half = tmp_path / "whole" / "checkpoints" / "step_000024.ckpt"
    resumed, again = run(tmp_path / "resumed", *overrides, f"ckpt={half}")
    assert trainer.global_step == again.global_step == 33
    whole, resumed = state_of(whole, trainer), state_of(resumed, again)
    assert [name for name in whole if not torch.equal(whole[name], resumed[name])] == []
    rates = [{group["name"]: group["lr"] for group in one.optimizers[0].param_groups} for one in (trainer, again)]
    assert rates[0] == rates[1] and rates[0]["means"] == pytest.approx(
        0.1 * 1.6e-4 * again.lightning_module.scene.extent, rel=0.2
    )
