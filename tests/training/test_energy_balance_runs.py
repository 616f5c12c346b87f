"""Whole runs of the energy balance on the yard: training, a checkpoint under other weather, what it costs to switch parts."""

import json
from dataclasses import replace

import torch
from running import NO_PICTURES, run

from heatsplat.physics.units import KELVIN_AT_0_C

SHORT = (
    "method=energy_balance",
    "data.size=tiny",
    "data.downscale=2",
    "threads=1",
    "callbacks.images=null",
    "callbacks.viewer=null",
    *NO_PICTURES,
    "callbacks.attributes=null",
    "callbacks.probes=null",
    "callbacks.costs.fps_repeats=1",
    "trainer.limit_val_batches=1",
    "trainer.limit_test_batches=2",
)


def test_a_run_learns_tells_its_effects_and_answers_in_other_weather(tmp_path):
    module, trainer = run(tmp_path, *SHORT, "max_steps=30", "trainer.val_check_interval=30")
    scene = module.scene
    results = json.loads((tmp_path / "metrics.json").read_text())
    assert set(results["effects"]) == {"convection", "solar", "radiation"}
    start = torch.tensor(3600.0)
    assert (module.splats["log_rate"] + start.log()).abs().max() > 0.1  # what is learned has moved
    moment = scene.test.times_s[0]
    before = module.thermal.temperature(module.splats, moment)
    assert before.isfinite().all()
    assert (before > KELVIN_AT_0_C - 30).all()
    assert (before < KELVIN_AT_0_C + 120).all()

    trainer.datamodule.weather, kept = "overcast", scene.weather
    trainer.datamodule.size = replace(trainer.datamodule.size, frames=4)  # of the other weather images do not matter
    other = trainer.datamodule.load()
    module.thermal.prepare(other)
    overcast = module.thermal.temperature(module.splats, moment)
    assert (overcast - before).abs().max() > 1.0
    module.thermal.under(kept)
    torch.testing.assert_close(module.thermal.temperature(module.splats, moment), before)


def test_the_full_balance_goes_on_from_a_checkpoint_bit_for_bit(tmp_path):
    """Stopped between marches, after splits: what was marched when is part of the state."""
    overrides = (*SHORT, "max_steps=120", "thermal.solution=corrected", "trainer.val_check_interval=120", "test=false")
    overrides += ("callbacks.checkpoint.every_n_train_steps=57",)
    module, _ = run(tmp_path / "whole", *overrides)
    assert module.thermal.effects()["radiation"]["power"] == "T⁴"
    resumed, _ = run(tmp_path / "on", *overrides, f"ckpt={tmp_path / 'whole/checkpoints/step_000057.ckpt'}")
    whole = module.splats.state_dict()
    assert all(torch.equal(tensor, whole[name]) for name, tensor in resumed.splats.state_dict().items())
    assert (whole["raw.marched_at"][:, 1] - module.splats["log_rate"]).abs().max() > 1e-3
