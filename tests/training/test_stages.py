"""Stages: which parameters are frozen at which steps, and that nothing of them changes then."""

import logging
import math

import pytest
import torch
from running import TINY, run

from heatsplat.training.stages import Freeze, Stages

RAVIGS = (
    *TINY,
    "method=ravigs",
    "callbacks.attributes=null",
    "test=false",
    "max_steps=40",
    "density.start=5",
    "density.every=10",
    "density.stop=30",
    "trainer.val_check_interval=40",
    "threads=1",
)


def frozen(freeze, steps):
    return [step for step in range(steps) if freeze.at(step)]


def test_a_stretch_has_a_first_step_and_ends_before_its_last():
    assert frozen(Freeze(["a"]), 4) == [0, 1, 2, 3]
    assert frozen(Freeze(["a"], start=2, stop=5), 9) == [2, 3, 4]
    assert frozen(Freeze(["a"], stop=0), 9) == []


def test_cycles_freeze_at_their_end_by_turns():
    one, two = (Freeze(["a"], start=3, cycle=5, share=0.4, turn=turn, turns=2) for turn in (0, 1))
    assert frozen(one, 25) == [6, 7, 16, 17]
    assert frozen(two, 25) == [11, 12, 21, 22]
    assert frozen(Freeze(["a"], cycle=5, share=0.0), 20) == []
    assert frozen(Freeze(["a"], stop=7, cycle=5, share=0.4), 20) == [3, 4]


def optimizer_of(weight_decay=0.0):
    generator = torch.Generator().manual_seed(0)
    shapes = {"sh0": (6, 1, 3), "sh_rest": (6, 3, 3), "opacity_logits": (6, 2), "thermal.gain": (), "single": (6, 1)}
    groups = [
        {
            "params": [torch.nn.Parameter(torch.randn(shape, generator=generator))],
            "name": name,
            "lr": 0.1,
            "weight_decay": weight_decay,
        }
        for name, shape in shapes.items()
    ]
    return torch.optim.Adam(groups, fused=True)


def take(stages, optimizer, steps):
    """Steps whose loss pulls at every parameter."""
    parameters = [group["params"][0] for group in optimizer.param_groups]

    def closure():
        optimizer.zero_grad()
        loss = sum(((i + 1) * parameter).sin().sum() for i, parameter in enumerate(parameters))
        loss.backward()
        return loss

    for step in steps:
        with stages.on_step(step, optimizer):
            optimizer.step(closure)


def snapshot(optimizer):
    """Values and moments of every group, and the number of steps that the optimiser took with it."""
    found = {}
    for group in optimizer.param_groups:
        (parameter,) = group["params"]
        state = {key: value for key, value in optimizer.state[parameter].items() if value.shape == parameter.shape}
        found[group["name"]] = {key: value.clone() for key, value in (state | {"value": parameter.detach()}).items()}
    return found


def moved(before, after):
    return [name for name in before if not torch.equal(before[name]["value"], after[name]["value"])]


def test_what_is_frozen_until_the_run_ends_tells_from_when():
    stretches = {
        "late": Freeze(["opacity_*"], start=40),
        "end": Freeze(["means", "opacity_logits"], start=25),
        "first": Freeze(["opacity_logits"], stop=10),
        "turns": Freeze(["opacity_logits"], start=5, cycle=4, share=0.5),
        "column": Freeze(["opacity_logits[1]"], start=3),
    }
    assert Stages(stretches).held_from("opacity_logits") == 25
    assert [Stages(stretches).freezes_at("means", step) for step in (9, 24, 25)] == [False, False, True]
    assert [Stages(stretches).freezes_at("opacity_logits", step) for step in (3, 10, 11)] == [True, False, True]
    assert Stages(stretches, restarts=[20]).held_from("opacity_logits") == Stages({}).held_from("means") == math.inf


def test_what_is_frozen_keeps_value_and_moments_and_pays_no_penalty():
    optimizer = optimizer_of(weight_decay=0.1)
    stages = Stages({"color": Freeze(["sh*"], start=3, stop=6), "gain": None})
    take(stages, optimizer, range(3))
    before = snapshot(optimizer)
    take(stages, optimizer, range(3, 6))
    after = snapshot(optimizer)
    assert moved(before, after) == ["opacity_logits", "thermal.gain", "single"]
    for name in ("sh0", "sh_rest"):
        assert all(torch.equal(before[name][key], after[name][key]) for key in ("exp_avg", "exp_avg_sq"))
    take(stages, optimizer, [6])
    assert "sh0" in moved(after, snapshot(optimizer))
    assert all(group["params"][0].requires_grad for group in optimizer.param_groups)


def test_what_waited_for_more_views_is_forgotten_when_it_is_frozen():
    optimizer = optimizer_of()
    parameters = {group["name"]: group["params"][0] for group in optimizer.param_groups}
    for parameter in parameters.values():
        parameter.grad = torch.ones_like(parameter)
    before = {name: parameter.detach().clone() for name, parameter in parameters.items()}
    with Stages({"a": Freeze(["sh*"])}).on_step(0, optimizer):
        optimizer.step()
    unmoved = {name for name, parameter in parameters.items() if torch.equal(parameter, before[name])}
    assert unmoved == {"sh0", "sh_rest"}


def test_a_frozen_column_gathers_nothing_for_the_next_update():
    optimizer = optimizer_of()
    (opacities,) = next(group["params"] for group in optimizer.param_groups if group["name"] == "opacity_logits")
    stages = Stages({"opacity": Freeze(["opacity_logits[1]"], stop=2)})
    opacities.grad = torch.ones_like(opacities)  # waits for more views
    for step in range(2):
        with stages.on_step(step, optimizer):
            opacities.grad += 1.0
    assert opacities.grad[:, 0].eq(3.0).all() and opacities.grad[:, 1].eq(0.0).all()


@pytest.mark.parametrize("warm", [0, 3])
def test_a_column_is_frozen_alone(warm):
    optimizer = optimizer_of(weight_decay=0.1)
    stages = Stages({"opacity": Freeze(["opacity_logits[1]"], start=warm)})
    take(stages, optimizer, range(warm))
    before = snapshot(optimizer)["opacity_logits"]
    take(stages, optimizer, range(warm, warm + 3))
    after = snapshot(optimizer)["opacity_logits"]
    assert torch.equal(before["value"][:, 1], after["value"][:, 1])
    assert not torch.equal(before["value"][:, 0], after["value"][:, 0])
    for key in ("exp_avg", "exp_avg_sq"):
        kept = before[key][:, 1] if warm else torch.zeros(6)
        assert torch.equal(after[key][:, 1], kept) and (after[key][:, 0] != 0).all()


def test_a_shared_column_is_left_alone():
    optimizer = optimizer_of()
    before = snapshot(optimizer)
    take(Stages({"opacity": Freeze(["single[0]", "single[1]", "opacity_logits[7]"])}), optimizer, range(2))
    assert "single" in moved(before, snapshot(optimizer)) and "opacity_logits" in moved(before, snapshot(optimizer))


def test_a_failure_within_a_step_leaves_parameters_trainable():
    optimizer = optimizer_of()
    with pytest.raises(RuntimeError, match="boom"), Stages({"all": Freeze(["*"])}).on_step(0, optimizer):
        raise RuntimeError("boom")
    assert all(group["params"][0].requires_grad for group in optimizer.param_groups)


def test_names_that_fit_nothing_are_told(caplog):
    with caplog.at_level(logging.WARNING):
        Stages({"typo": Freeze(["shh*", "opacity_logits[4]"]), "fine": Freeze(["nothing", "sh0"])}).check(
            optimizer_of()
        )
    assert "stage 'typo' freezes nothing: none of shh*, opacity_logits[4] is a parameter group" in caplog.text
    assert "fine" not in caplog.text


def test_errors():
    with pytest.raises(ValueError, match="groups must be a list of names of parameter groups, got 'sh0'"):
        Freeze("sh0")
    with pytest.raises(ValueError, match="start and stop are steps of 0 or more, got -1 and None"):
        Freeze(["sh0"], start=-1)
    with pytest.raises(ValueError, match="start and stop are steps of 0 or more, got 0 and -5"):
        Freeze(["sh0"], stop=-5)
    with pytest.raises(ValueError, match="cycle must be at least 1 step, or null, got 0"):
        Freeze(["sh0"], cycle=0)
    with pytest.raises(ValueError, match=r"share lies in \[0, 1\] and turn in 0 to turns - 1, got 0.5, 2 of 2"):
        Freeze(["sh0"], share=0.5, turn=2, turns=2)


# Whole runs -----------------------------------------------------------------------------------------


def state_of(module, trainer):
    found = {name: value.clone() for name, value in module.state_dict().items()}
    for group in trainer.optimizers[0].param_groups:
        for key, value in trainer.optimizers[0].state[group["params"][0]].items():
            found[f"{group['name']}.{key}"] = torch.as_tensor(value).clone()
    return found


def test_a_resumed_run_with_stages_equals_an_uninterrupted_one_bit_for_bit(tmp_path):
    """The checkpoint lies in the middle of a freeze: of the colour, from step 19 to 23."""
    freezes = (
        "stages.freezes.rgb.start=10",
        "stages.freezes.rgb.cycle=13",
        "stages.freezes.rgb.share=0.3",
        "stages.freezes.constants.stop=25",
    )
    overrides = (*RAVIGS, *freezes, "callbacks.checkpoint.every_n_train_steps=20")
    whole = state_of(*run(tmp_path / "whole", *overrides))
    half = tmp_path / "whole" / "checkpoints" / "step_000020.ckpt"
    resumed = state_of(*run(tmp_path / "resumed", *overrides, f"ckpt={half}"))
    assert whole.keys() == resumed.keys()
    assert [name for name in whole if not torch.equal(whole[name], resumed[name])] == []
    assert whole["thermal.raw_gain.step"] == 40 - 25  # gain waited until step 25
    assert len(whole["splats.raw.means"]) != 600  # density control was at work


def test_the_schedule_of_ravigs_holds_each_band_still_by_turns(tmp_path, monkeypatch):
    """Of the 40 steps the first 4 train all; then cycles of 5 whose last freezes colour and heat by turns."""
    from heatsplat.training.module import SplatTraining

    names = ("sh0", "emissivity", "temperature", "reflectance", "means")
    step_of, changed = SplatTraining.optimizer_step, []

    def values(module):
        found = {name: module.splats[name].detach().clone() for name in names}
        opacities = module.splats["opacity_logits"].detach().clone()
        return found | {"opacity of heat": opacities[:, 0], "opacity of colour": opacities[:, 1]}

    def watched(self, *args, **kwargs):
        before = values(self)
        step_of(self, *args, **kwargs)
        after = values(self)
        changed.append({name for name in before if not torch.equal(before[name], after[name])})

    monkeypatch.setattr(SplatTraining, "optimizer_step", watched)
    run(tmp_path, *RAVIGS, "density.start=1000")
    color, heat = {"sh0", "opacity of colour"}, {"emissivity", "temperature", "reflectance", "opacity of heat"}
    assert len(changed) == 40
    for step, moving in enumerate(changed):
        cycle, place = divmod(step - 4, 5)
        still = set() if step < 4 or place < 4 else color if cycle % 2 == 0 else heat
        assert moving == (color | heat | {"means"}) - still, step
