"""Thermal3D-GS as a recipe: at first it is 3DGS, its parts can be left out, its rates are the paper's."""

from types import SimpleNamespace

import pytest
import torch
from running import TINY

from heatsplat.composition import build, compose

SCENE = (*TINY, "synthetic_preset=haze")


def prepared(tmp_path, *overrides):
    plain = compose([*SCENE, *overrides])
    module = build(plain["module"])
    module.attach(build(plain["data"]).scene)
    return module


def test_before_training_its_images_are_those_of_3dgs(tmp_path):
    ours, plain = (prepared(tmp_path, f"method={name}") for name in ("thermal3dgs", "3dgs"))
    for frame in ours.scene.train.frames[::7]:
        assert torch.equal(ours.predict(frame), plain.predict(frame))


def test_what_is_left_out_has_no_parameter_and_no_term(tmp_path):
    bare = prepared(tmp_path, "method=thermal3dgs", "thermal=static", "sensor=none", "loss.terms.corner=null")
    names = {name for name, _ in bare.named_parameters()}
    assert names == {name for name, _ in prepared(tmp_path, "method=3dgs").named_parameters()}
    assert set(bare.loss.terms) == {"photometric"}
    full = prepared(tmp_path, "method=thermal3dgs", "thermal.width=256", "thermal.depth=8", "thermal.skip=5")
    assert {name.split(".")[0] for name, _ in full.named_parameters()} == {"splats", "thermal", "sensor"}
    assert 0.48e6 < full.thermal.cost < 0.5e6


def rates(module, steps: int) -> dict[str, tuple[float, float]]:
    """Learning rates of all parameters at the first step and at the last of a run."""
    module.trainer = SimpleNamespace(max_steps=steps)
    built = module.configure_optimizers()
    first = {group["name"]: group["lr"] for group in built["optimizer"].param_groups}
    factors = built["lr_scheduler"]["scheduler"].lr_lambdas
    return {name: (lr, lr * factor(steps)) for (name, lr), factor in zip(first.items(), factors, strict=True)}


@pytest.mark.parametrize("part", ["thermal.layers.0.weight", "sensor.conduction.last.weight"])
def test_every_part_has_the_rates_of_the_paper(part, tmp_path):
    module = prepared(tmp_path, "method=thermal3dgs", "max_steps=30000")
    first = 8e-4 if part.startswith("thermal") else 1.6e-5
    assert rates(module, 30_000)[part] == pytest.approx((first, 1.6e-6))


@pytest.mark.parametrize("steps, pace", [(1875, 4.0), (30_000, 1.0)])
def test_its_network_learns_faster_in_a_shorter_run_and_with_the_papers_settings_does_not(steps, pace, tmp_path):
    part = "thermal.layers.0.weight"
    for recipe, factor in (([], pace), (["recipe=published"], 1.0)):
        module = prepared(tmp_path, "method=thermal3dgs", f"max_steps={steps}", *recipe)
        assert rates(module, steps)[part][0] == pytest.approx(factor * 8e-4)
