"""ThermalGS and 4DGS as recipes: with untrained networks they are 3DGS, in both stages and with every head."""

import pytest
import torch
from running import TINY

from heatsplat.composition import build, compose

ALL_HEADS = "thermal.heads=[means,scales,rotations,opacity,radiance]"
RECIPES = [("method=thermalgs",), ("method=hexplane_4dgs",), ("method=hexplane_4dgs", ALL_HEADS)]


def prepared(tmp_path, *overrides):
    plain = compose([*TINY, "synthetic_preset=cooling", "max_steps=1000", *overrides])
    module = build(plain["module"])
    module.attach(build(plain["data"]).scene)
    return module


@pytest.mark.parametrize("recipe", RECIPES, ids=["thermalgs", "hexplane_4dgs", "all heads"])
def test_before_training_images_are_those_of_3dgs_and_the_field_is_asked_once(recipe, tmp_path):
    plain, ours = prepared(tmp_path, "method=3dgs"), prepared(tmp_path, *recipe)
    network = ours.thermal.trunk if hasattr(ours.thermal, "trunk") else ours.thermal.hidden
    calls = []
    network.register_forward_hook(lambda *_: calls.append(1))
    frame = ours.scene.train.frames[3]
    expected = plain.predict(frame)
    first = ours.thermal.first_steps
    assert first == (300 if "thermalgs" in recipe[0] else 100)
    ours.thermal.on_step(first - 1)
    # Sizes and opacities of a model that moves are activated before projection, which may round the last digit differently.
    torch.testing.assert_close(ours.predict(frame), expected, rtol=0, atol=1e-5)
    assert not calls
    ours.thermal.on_step(first)
    torch.testing.assert_close(ours.predict(frame), expected, rtol=0, atol=1e-5)
    assert calls == [1]


def test_a_change_of_one_head_shows_in_the_image(tmp_path):
    module = prepared(tmp_path, "method=hexplane_4dgs", ALL_HEADS)
    module.thermal.on_step(1000)
    with torch.no_grad():
        module.splats["log_scales"][:, 0] += 1.0  # of balls no one sees the rotation
    frame = module.scene.train.frames[3]
    before = module.predict(frame)
    for head in module.thermal.heads.values():
        with torch.no_grad():
            head[-1].bias += 0.2
        changed = module.predict(frame)
        assert (changed - before).abs().max() > 1e-3
        with torch.no_grad():
            head[-1].bias -= 0.2
    assert torch.equal(module.predict(frame), before)
