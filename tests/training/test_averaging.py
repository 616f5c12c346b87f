"""Means of parameters over the last updates: against numpy, in whole runs, and on the way through checkpoints."""

import numpy as np
import pytest
import torch
from running import BARE, TINY, run

from heatsplat.composition import compose
from heatsplat.thermal.energy_balance import EnergyBalance
from heatsplat.thermal.static import Static
from heatsplat.training.averaging import Average
from heatsplat.training.module import SplatTraining
from heatsplat.training.optimisation import Optimisation

TAIL = (*TINY, "max_steps=40", "test=false", "optim.averaged=0.25", "optim.accumulate=3", "optim.accumulate_from=0.2")


def test_the_mean_of_many_updates_is_that_of_float64():
    generator = np.random.default_rng(0)
    walk = (1e3 + generator.normal(size=(375, 500))).astype(np.float32)  # 30,000 steps take 375 of them
    average = Average()
    assert not average
    for values in walk:
        average.take([("x", torch.from_numpy(values))])
    found = torch.zeros(500)
    assert average and average.give([("x", found), ("other", torch.ones(2))]) == 375 and not average
    exact = walk.astype(np.float64).mean(0)
    assert np.abs(found.numpy() - exact).max() < 16 * np.spacing(np.float32(1e3))
    assert average.give([("x", found)]) == 0  # forgotten


def test_it_begins_anew_where_gaussians_come_or_go():
    average = Average()
    average.take([("x", torch.zeros(3)), ("y", torch.zeros(1))])
    average.take([("x", torch.full((4,), 2.0)), ("y", torch.ones(1))])
    average.take([("x", torch.full((4,), 4.0)), ("y", torch.ones(1))])
    x, y = torch.zeros(4), torch.zeros(1)
    assert average.give([("x", x), ("y", y)]) == 2
    assert x.tolist() == [3.0] * 4 and y.tolist() == [1.0]


def test_a_checkpoint_goes_on_with_it():
    whole, first, second = Average(), Average(), Average()
    values = torch.rand(7, 5, generator=torch.Generator().manual_seed(1))
    for k, value in enumerate(values):
        whole.take([("x", value)])
        (first if k < 4 else second).take([("x", value)])
        if k == 3:
            second.load_state_dict(first.state_dict(), torch.device("cpu"))
    one, other = torch.zeros(5), torch.zeros(5)
    assert whole.give([("x", one)]) == second.give([("x", other)]) == 7
    assert torch.equal(one, other)


@pytest.mark.parametrize("method", ["etgs", "ti3dgs"])
def test_a_run_ends_with_the_mean_of_its_last_updates(method, tmp_path, monkeypatch):
    steps, step_of = [], SplatTraining.optimizer_step

    def noted(self, *arguments):
        before = self.global_step
        step_of(self, *arguments)
        parameters = {name: value.detach().double() for name, value in self.named_parameters()}
        steps.append((before, self._updates(before), parameters))

    monkeypatch.setattr(SplatTraining, "optimizer_step", noted)
    module, _ = run(tmp_path, *TAIL, f"method={method}", "density.stop=20")
    last = [parameters for step, updated, parameters in steps if updated and step + 1 > 30]
    assert [step for step, updated, _ in steps if updated and step + 1 > 30] == [32, 35, 38, 39]
    assert module.results.run["averaged_updates"] == 4
    for name, value in module.named_parameters():
        mean = sum(parameters[name] for parameters in last) / 4
        torch.testing.assert_close(value.detach().double(), mean, rtol=1e-5, atol=1e-6)
    moved = (module.splats["means"].double() - last[-1]["splats.raw.means"]).abs().max()
    assert moved > 1e-4  # it is not the last update


def test_a_run_that_goes_on_for_longer_averages_its_own_last_updates(tmp_path):
    settings = (
        *TAIL,
        "method=3dgs",
        "density=fixed",
        "optim.accumulate=1",
        "callbacks.checkpoint.every_n_train_steps=20",
    )
    run(tmp_path / "short", *settings)
    ended = tmp_path / "short" / "checkpoints" / "step_000040.ckpt"  # before the mean took the place of the last update
    assert torch.load(ended, weights_only=True)["heatsplat"]["average"]["count"] == 10
    module, _ = run(tmp_path / "long", *settings, "max_steps=60", f"ckpt={ended}")
    assert module.results.run["averaged_updates"] == 15


def test_none_is_kept_where_it_is_off(tmp_path):
    module, _ = run(tmp_path / "off", *TAIL, "method=3dgs", "optim.averaged=0")
    assert "averaged_updates" not in module.results.run
    checkpoint = torch.load(tmp_path / "off" / "checkpoints" / "last.ckpt", weights_only=True)
    assert "average" not in checkpoint["heatsplat"]


def test_models_of_weather_average_over_half_a_run_and_others_over_a_tenth_unless_asked(tmp_path, monkeypatch):
    short = (*BARE, "method=3dgs", "density=fixed", "max_steps=20", "optim.accumulate=1")

    def averaged(*overrides):
        return run(tmp_path, *short, *overrides)[0].results.run["averaged_updates"]

    assert averaged() == averaged("optim.averaged=0.1") < averaged("optim.averaged=0.25") == 5
    monkeypatch.setattr(Static, "averaged", EnergyBalance.averaged)
    assert averaged() == 10 and averaged("optim.averaged=0.25") == 5
    assert compose(["method=energy_balance", "recipe=published"])["optim"]["averaged"] == 0


def test_only_the_last_round_is_averaged(tmp_path):
    module, _ = run(tmp_path, *TAIL, "method=mftg")
    assert module.schedule.restarts and module.results.run["averaged_updates"] < 10


def test_a_share_is_from_0_to_1(tmp_path):
    for options in ({"accumulate_from": -1.0}, {"steps": -1}):
        with pytest.raises(ValueError, match=f"optim.{next(iter(options))} .*, got -1"):
            Optimisation(**options)
    with pytest.raises(Exception, match="optim.averaged is a share of the run, from 0 to 1, or null, got 2"):
        run(tmp_path, *TAIL, "method=3dgs", "optim.averaged=2")


def test_sizes_before_a_reset_are_no_part_of_the_mean(tmp_path):
    short = (*BARE, "method=3dgs", "density=fixed", "max_steps=20", "optim.accumulate=1", "optim.averaged=0.5")
    resets = ("overlap=short_lists", "overlap.entropy=0", "overlap.reset_every=14", "overlap.reset_start=0")
    module, _ = run(tmp_path, *short, *resets, "overlap.reset_stop=20")
    assert module.results.run["averaged_updates"] == 7  # after steps 13 to 19, the first of which resets
