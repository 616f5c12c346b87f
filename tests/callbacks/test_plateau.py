"""Runs that gain no more end early, in a short tail; those that do are left alone."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from fake_run import wall

from heatsplat.callbacks.budget import BudgetClock
from heatsplat.callbacks.plateau import Plateau, squared_error
from heatsplat.contracts import SceneError, ViewSet
from heatsplat.density.base import DensityControl
from heatsplat.io.results import RunResults
from heatsplat.training.overlap import Overlap, ShortLists
from heatsplat.training.schedule import Schedule
from heatsplat.training.stages import Freeze, Stages

STEPS = 300
NOISE = 0.004  # of the wall's images


def module_of(stages=None, overlap=None):
    density = DensityControl()
    density.cap_max = 1000
    return SimpleNamespace(
        scene=wall(),
        modality="thermal",
        schedule=Schedule(STEPS),
        density=density,
        splats=range(300),
        results=RunResults(),
        stages=stages or Stages({}),
        overlap=overlap or Overlap(),
        resolution=SimpleNamespace(whole=True),
    )


def trained(error, stopped_at=None, **parts):
    """(module, callback) after a run whose root mean squared error after a share of the plan is ``error(share)``.

    With ``stopped_at`` it is stopped there, and a new callback and module go on from the state.
    """
    module, callback = module_of(**parts), Plateau()
    run = SimpleNamespace(callbacks=[callback], global_step=0)
    callback.on_fit_start(run, module)
    callback.on_train_start(run, module)
    views = list(module.scene.train)
    while run.global_step < module.schedule.end:
        view = views[run.global_step % len(views)]
        run.global_step += 1
        outputs = {"prediction": view.thermal + error(run.global_step / STEPS)}
        callback.on_train_batch_end(run, module, outputs, view)
        if run.global_step == stopped_at:
            state, schedule = callback.state_dict(), module.schedule.state_dict()
            module, callback = module_of(**parts), Plateau()
            module.schedule.load_state_dict(schedule)
            callback.on_fit_start(run, module)
            callback.load_state_dict(state)
            callback.on_train_start(run, module)
    callback.on_train_end(run, module)
    return module, callback


def test_a_run_that_gains_no_more_ends_after_a_short_tail():
    module, _ = trained(lambda share: 0.2 if share < 0.25 else 0.1)
    found = module.results.run["early_stop"]
    assert found["planned_steps"] == STEPS
    assert found["at_step"] == 0.5 * STEPS
    assert module.schedule.end == found["steps"] == 0.6 * STEPS
    assert module.schedule.progress(found["steps"]) == 1.0
    assert module.density.cap_max == 300
    assert found["residual"] == pytest.approx(0.1, rel=0.01)


def test_an_image_of_which_no_pixel_counts_does_not_keep_a_run_going(monkeypatch):
    scene = wall()
    views = list(scene.train)
    views[0] = replace(views[0], mask=torch.zeros(views[0].thermal.shape[:2], dtype=torch.bool))
    masked = replace(scene, train=ViewSet([view.frame for view in views], lambda i: views[i]))
    whole, _ = trained(lambda share: 0.2 if share < 0.25 else 0.1)
    monkeypatch.setitem(module_of.__globals__, "wall", lambda: masked)
    module, _ = trained(lambda share: 0.2 if share < 0.25 else 0.1)
    assert module.schedule.end == whole.schedule.end == 0.6 * STEPS


def test_a_run_that_goes_on_gaining_is_left_alone():
    module, _ = trained(lambda share: 0.1 * (1 - 0.2 * share))
    assert module.schedule.end == STEPS
    assert "early_stop" not in module.results.run
    assert module.density.cap_max == 1000


def test_a_last_round_or_stage_is_waited_for():
    """Where the image that is scored does not train at first, its error is flat."""
    late = Stages({"geometry": Freeze(["means"], start=120)})
    for stages in (late, Stages({}, restarts=[120]), Stages({"first": Freeze(["heat"], stop=120)})):
        module, _ = trained(lambda share: 0.1, stages=stages)
        assert module.results.run["early_stop"]["at_step"] == 180
    in_turns = Stages({"geometry": Freeze(["means"], start=120, cycle=10, share=0.5)})
    assert trained(lambda share: 0.1, stages=in_turns)[0].results.run["early_stop"]["at_step"] == 90


def test_no_run_ends_where_sizes_were_just_reset():
    short = ShortLists(reset_every=80, reset_start=0, reset_stop=161)
    module, _ = trained(lambda share: 0.1, overlap=short)  # resets after 80 and 160 steps, each mended in 40
    found = module.results.run["early_stop"]
    assert found["at_step"] == 240 and found["steps"] == 270  # at 150 the next reset is too near
    module.resolution.whole = False
    with pytest.raises(SceneError, match="callbacks=plateau judges whole images"):
        Plateau().on_fit_start(SimpleNamespace(callbacks=[]), module)


def test_errors_that_rise_are_no_plateau():
    module, _ = trained(lambda share: 0.1 + 0.05 * share)
    assert module.schedule.end == STEPS


def test_what_is_below_the_noise_of_the_camera_is_not_waited_for():
    """The error falls by a fifth in every tenth, but all of it is noise that no model can learn."""
    module, _ = trained(lambda share: NOISE * (1.0 - 0.5 * share))
    assert "below the noise" in module.results.run["early_stop"]["why"]
    assert module.results.run["early_stop"]["camera_noise"] == pytest.approx(NOISE, rel=0.3)


def test_a_resumed_run_ends_where_the_uninterrupted_one_does():
    for stopped_at in (100, 160):  # before the plateau is seen, and in the tail
        whole, _ = trained(lambda share: 0.2 if share < 0.25 else 0.1)
        resumed, _ = trained(lambda share: 0.2 if share < 0.25 else 0.1, stopped_at)
        assert resumed.results.run["early_stop"] == whole.results.run["early_stop"]
        assert resumed.density.cap_max == whole.density.cap_max


def test_a_run_that_goes_on_for_longer_is_judged_anew():
    (_, judged), (module, callback) = trained(lambda share: 0.2 if share < 0.25 else 0.1), (module_of(), Plateau())
    module.schedule = Schedule(2 * STEPS)
    callback.load_state_dict(judged.state_dict())
    callback.on_train_start(None, module)
    callback.on_train_end(None, module)
    assert module.density.cap_max == 1000 and "early_stop" not in module.results.run
    assert callback.state_dict() == Plateau().state_dict()


def test_errors_after_a_reset_of_opacities_do_not_count():
    class Resetting(DensityControl):
        def settled(self, step):
            return step >= 0.8 * STEPS

    module, callback = module_of(), Plateau()
    module.density = Resetting()
    run = SimpleNamespace(callbacks=[callback], global_step=0)
    callback.on_fit_start(run, module)
    views = list(module.scene.train)[:2]
    for run.global_step in range(1, round(0.9 * STEPS) + 1):
        view = views[run.global_step % 2]
        callback.on_train_batch_end(run, module, {"prediction": view.thermal + 0.1}, view)
    assert module.schedule.end == STEPS


def test_finer_predictions_are_compared_on_the_grid_of_the_image():
    image = torch.rand(4, 6, 1)
    fine = image.repeat_interleave(2, 0).repeat_interleave(2, 1) + 0.5
    mask = torch.zeros(4, 6, dtype=torch.bool)
    mask[0, 0] = True
    assert float(squared_error(fine, image, mask)) == pytest.approx(0.25, rel=1e-5)


def test_a_budget_beside_it_and_options_out_of_range_are_refused():
    run = SimpleNamespace(callbacks=[BudgetClock({"train_s": 1, "steps": 10}, "")])
    with pytest.raises(SceneError, match="budget"):
        Plateau().on_fit_start(run, module_of())
    for options in ({"after": 1.0}, {"min_gain": 0.0}, {"tail": 0.0}):
        with pytest.raises(ValueError, match="must lie in"):
            Plateau(**options)
