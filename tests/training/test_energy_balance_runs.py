"""Whole runs of the energy balance on the yard: training, a checkpoint under other weather, what it costs to switch parts."""

import json

import torch
from running import run

from heatsplat.physics.units import KELVIN_AT_0_C

SHORT = (
    "method=energy_balance",
    "data.size=tiny",
    "data.downscale=2",
    "threads=1",
    "callbacks.images=null",
    "callbacks.attributes=null",
    "callbacks.probes=null",
    "callbacks.costs.fps_repeats=1",
    "trainer.limit_val_batches=1",
    "trainer.limit_test_batches=2",
)


def test_a_run_learns_tells_its_effects_and_answers_in_other_weather(tmp_path):
    module, trainer = run(tmp_path, *SHORT, "max_steps=60", "trainer.val_check_interval=30")
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
    other = trainer.datamodule.load()
    module.thermal.prepare(other)
    overcast = module.thermal.temperature(module.splats, moment)
    assert (overcast - before).abs().max() > 1.0
    module.thermal.under(kept)
    torch.testing.assert_close(module.thermal.temperature(module.splats, moment), before)


def test_the_full_balance_trains_too(tmp_path):
    module, _ = run(
        tmp_path, *SHORT, "max_steps=6", "thermal.solution=corrected", "trainer.val_check_interval=6", "test=false"
    )
    assert module.thermal.effects()["radiation"]["power"] == "T⁴"
    assert all(parameter.isfinite().all() for parameter in module.splats.parameters())
