"""Whole runs under rules of density control: every method lives through them, and a stopped run goes on bit for bit."""

import itertools

import pytest
import torch
from helpers import OF_GAUSSIANS
from running import BARE, QUIET, run

from heatsplat.thermal.static import Static
from heatsplat.training.adam import OnePassAdam
from heatsplat.training.checkpoints import load_checkpoint
from heatsplat.training.module import CHECKPOINT_KEY, SplatTraining

RULES = {
    "multiview_gate": (
        "density.start=5", "density.every=10", "density.views=5", "density.stop=20", "density.gate_pixels=0.1",
        "density.late_every=10", "density.late_stop=40",
    ),
    "budget": ("density.start=5", "density.every=10", "density.stop=30", "density.remove_at=[1,17]"),
    "mcmc": ("density.start=5", "density.every=10", "density.stop=40", "density.dead_opacity=0.08"),
}  # fmt: skip

GATHERED = {"multiview_gate": ("gradient", "seen"), "budget": ("pull", "worth", "wrong", "weight"), "mcmc": ()}


BRIEF = {  # the same in ten steps
    "multiview_gate": (
        "density.start=2", "density.every=4", "density.views=2", "density.stop=8", "density.late_every=4", "density.late_stop=12",
    ),
    "budget": ("density.start=2", "density.every=4", "density.stop=9", "density.remove_at=[1,7]"),
    "mcmc": ("density.start=2", "density.every=4", "density.stop=12"),
}  # fmt: skip


def overrides(rule: str, *more: str) -> tuple[str, ...]:
    return (
        *QUIET,
        f"density={rule}",
        *RULES[rule],
        "max_steps=26",
        "optim.length_power=0",  # rates of 30 000 steps in 26 would be 34 times the papers'
        *more,
    )


def state_of(module, trainer) -> dict[str, torch.Tensor]:
    found = {name: value.clone() for name, value in module.state_dict().items()}
    for group in trainer.optimizers[0].param_groups:
        for key, value in trainer.optimizers[0].state[group["params"][0]].items():
            found[f"{group['name']}.{key}"] = torch.as_tensor(value).clone()
    return found


@pytest.mark.parametrize(
    ("rule", "method", "views"),
    [("multiview_gate", "etgs", 4), ("budget", "etgs", 1), ("budget", "ravigs", 4), ("mcmc", "etgs", 4)],
)
def test_a_resumed_run_equals_an_uninterrupted_one_bit_for_bit(rule, method, views, tmp_path):
    """Also while the gradients of a view wait for those of the next, and Gaussians come and go meanwhile."""
    views = f"optim.accumulate={views}", "optim.accumulate_from=0.25"
    given = overrides(rule, f"method={method}", "callbacks.checkpoint.every_n_train_steps=17", *views)
    module, trainer = run(tmp_path / "whole", *given)
    whole = state_of(module, trainer)
    half = tmp_path / "whole" / "checkpoints" / "step_000017.ckpt"  # between refinements, whose statistics it holds
    statistics = load_checkpoint(half)[CHECKPOINT_KEY]["density_state"]
    assert all(statistics[name].any() for name in GATHERED[rule])
    resumed = state_of(*run(tmp_path / "resumed", *given, f"ckpt={half}"))
    assert [name for name in whole if not torch.equal(whole[name], resumed[name])] == []
    assert len(module.splats) > 600  # density control was at work


def test_a_run_that_sums_gradients_of_views_moves_at_every_second_step_and_resumes_between_them(tmp_path, monkeypatch):
    given = (
        *QUIET, "method=etgs", "density=fixed", "optim=adamw", "optim.decoupled.opacity=0.1", "optim.accumulate=2",
        "max_steps=12", "callbacks.checkpoint.every_n_train_steps=9",
    )  # fmt: skip
    opacities = []
    end = SplatTraining.on_train_batch_end
    monkeypatch.setattr(
        SplatTraining,
        "on_train_batch_end",
        lambda self, *rest: (opacities.append(self.splats["opacity_logits"].detach().clone()), end(self, *rest)),
    )
    whole = state_of(*run(tmp_path / "whole", *given))
    moved = [not torch.equal(one, two) for one, two in itertools.pairwise(opacities)]
    assert moved == [True] * 5 + [False, True] * 3  # from step 6 on, after 7, 9 and 11
    half = tmp_path / "whole" / "checkpoints" / "step_000009.ckpt"  # one view waits
    resumed = state_of(*run(tmp_path / "resumed", *given, f"ckpt={half}"))
    assert [name for name in whole if not torch.equal(whole[name], resumed[name])] == []


@pytest.mark.parametrize(
    ("ends", "cleared"),
    [({5: 75, 8: 8}, [0, 1, 2, 3, 4, 5, 6]), ({7: 9}, [0, 1, 2, 3, 4, 5, 6, 8])],
    ids=["later", "sooner"],
)
def test_gradients_count_once_where_the_end_of_a_run_is_moved(ends, cleared, tmp_path, monkeypatch):
    """As a budget of time moves it: what the moved plan says of the last step is not what was done in it."""
    found, done, clear, batch_end = [], [0], OnePassAdam.zero_grad, SplatTraining.on_train_batch_end

    def moved(self, *rest):
        done[0] = self.global_step
        if self.global_step in ends:
            self.schedule.end_at(self.global_step, ends[self.global_step])
        batch_end(self, *rest)

    monkeypatch.setattr(SplatTraining, "on_train_batch_end", moved)
    monkeypatch.setattr(OnePassAdam, "zero_grad", lambda self, *rest: (found.append(done[0]), clear(self, *rest)))
    run(
        tmp_path,
        *BARE,
        "method=3dgs",
        "density=fixed",
        "optim.accumulate=2",
        "optim.accumulate_from=0.4",
        "max_steps=12",
    )
    assert found == cleared


def test_a_whole_pass_of_the_views_is_judged_in_every_round(tmp_path, monkeypatch):
    judged = []
    step_of = SplatTraining.training_step

    def training_step(self, view, batch_idx):
        if self.global_step >= 7 and self.density.maps_at(self.schedule.round_step(self.global_step)) == 1:
            judged.append(view.frame.name)
        return step_of(self, view, batch_idx)

    monkeypatch.setattr(SplatTraining, "training_step", training_step)
    given = overrides("budget", "method=etgs", "stages=fine_tuning", "+first_steps=7", "density.remove_at=[1]")
    module, _ = run(tmp_path, *given, "density.start=30", "max_steps=42")
    assert len(judged) == len(set(judged)) == len(module.scene.train)


@pytest.mark.parametrize(
    ("method", "more", "resets"),
    [
        ("3dgs", ("optim.accumulate=4", "optim.accumulate_from=0"), [10, 20, 30]),  # gradients wait meanwhile
        ("thermalgs", ("first_steps=25",), [10]),  # from where on geometry is frozen; ten refinements take ten steps
    ],
)
def test_opacities_are_reset_while_they_are_trained(method, more, resets, tmp_path, monkeypatch):
    steps, ended = [], SplatTraining.on_train_batch_end

    def noted(self, *rest):
        if self.density_change is not None and self.density_change.opacity_reset:
            steps.append(self.global_step)
        ended(self, *rest)

    monkeypatch.setattr(SplatTraining, "on_train_batch_end", noted)
    every = (
        "density.start=5",
        "density.every=1",
        "density.stop=36",
        "density.reset_every=10",
        "density.prune_opacity=0",
    )
    given = (*BARE, "density=adaptive", *every, "max_steps=40")
    run(tmp_path, *given, f"method={method}", *more)
    assert steps == resets


@pytest.mark.parametrize(
    ("rule", "more"),
    [
        ("budget", ("density.views=2", "density.floor=0", "density.remove_at=[18]")),
        ("mcmc", ()),
        ("adaptive", ("density.grad_threshold=1e-9", "density.prune_opacity=0.3")),
    ],
)
def test_no_gaussian_comes_or_goes_while_a_stage_freezes_where_they_lie(rule, more, tmp_path, monkeypatch, caplog):
    after, ended = [], SplatTraining.on_train_batch_end

    def noted(self, *rest):
        if self.global_step >= 10:
            after.append(
                {name: self.splats[name].detach().clone() for name in ("means", "log_scales", "opacity_logits")}
            )
        ended(self, *rest)

    monkeypatch.setattr(SplatTraining, "on_train_batch_end", noted)
    plan = ("density.start=2", "density.every=4", "density.stop=18", "max_steps=20", "cap_max=1200")
    run(tmp_path, *BARE, "method=thermalgs", "first_steps=10", f"density={rule}", *plan, *more)
    assert len(after) == 11 and len(after[0]["means"]) > 600
    assert all(torch.equal(now[name], after[0][name]) for now in after for name in now)
    assert "from step 10 on a stage freezes where Gaussians lie" in caplog.text
    assert "until step 18; give density.stop=10" in caplog.text


def test_models_are_told_where_as_many_gaussians_come_as_go(tmp_path, monkeypatch):
    steps, numbers = [], []
    monkeypatch.setattr(Static, "on_rows_changed", lambda self: steps.append(len(numbers)))
    monkeypatch.setattr(SplatTraining, "on_after_backward", lambda self: numbers.append(len(self.splats)))
    given = (*BARE, "method=3dgs", "density=mcmc", *RULES["mcmc"], *BRIEF["mcmc"], "max_steps=10", "cap_max=600")
    run(tmp_path, *given, "density.dead_opacity=0.6")
    assert steps == [4, 8] and set(numbers) == {600}


PAIRS = [  # every method of Gaussians under one of the rules; under the others where there is time
    pytest.param(rule, method, marks=() if i % len(RULES) == j else pytest.mark.slow)
    for i, method in enumerate(OF_GAUSSIANS)
    for j, rule in enumerate(RULES)
]


@pytest.mark.parametrize(("rule", "method"), PAIRS)
def test_every_method_lives_through_every_rule(rule, method, tmp_path):
    given = (*BARE, f"density={rule}", *RULES[rule], *BRIEF[rule], "max_steps=10", "optim.length_power=0")
    module, _ = run(tmp_path, *given, f"method={method}")
    assert len(module.splats) > 0
    assert all(bool(torch.isfinite(module.splats[name]).all()) for name in module.splats.names)
