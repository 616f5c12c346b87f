"""Decay beside Adam: its size, who it takes, its bounds, and that Adam does not see it."""

import math

import pytest
import torch
from running import BARE, run

from heatsplat.splats import Splats
from heatsplat.training.decoupled import DecoupledDecay
from heatsplat.training.optimisation import Optimisation
from heatsplat.training.schedule import Schedule

START = {"opacity_start": 0, "size_start": 0}


def stepped(gradient: float = 1e-3, steps: int = 3):
    """Three Gaussians after some steps of Adam with a constant gradient; the last one is not seen."""
    widths = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 2}
    cloud = Splats({name: torch.full((3, width), -1.0) for name, width in widths.items()})
    settings = Optimisation()
    optimizer, _ = settings.build(settings.geometry_groups(cloud, 1.0), Schedule(100).round_progress)
    for _ in range(steps):
        for parameter in cloud.raw.values():
            parameter.grad = torch.full_like(parameter, gradient)
            parameter.grad[2] = 0.0
        optimizer.step()
    return cloud, optimizer


def fall(rule: DecoupledDecay, cloud, optimizer, step=0, pixels=100, extent=2.0) -> dict[str, torch.Tensor]:
    before = {name: cloud[name].detach().clone() for name in cloud.names}
    moments = [value.clone() for state in optimizer.state.values() for value in state.values()]
    rule(optimizer, step, pixels, extent)
    after = [value for state in optimizer.state.values() for value in state.values()]
    assert all(torch.equal(one, two) for one, two in zip(moments, after, strict=True))  # Adam sees nothing of it
    return {name: before[name] - cloud[name].detach() for name in cloud.names}


def test_the_fall_is_that_of_the_paper():
    cloud, optimizer = stepped()
    opacity = cloud["opacity_logits"].detach().sigmoid()[0, 0].item()
    size = cloud["log_scales"].detach().exp()[0, 0].item()
    fell = fall(DecoupledDecay(opacity=0.2, size=0.3, **START), cloud, optimizer)
    expected = 0.05 * 0.2 * opacity * (1 - opacity) / 100 / 1e-3  # Adam's v without bias is the squared gradient
    assert fell["opacity_logits"][:2].flatten().tolist() == pytest.approx([expected] * 4, rel=1e-3)
    expected = 5e-3 * 0.3 / 2.0 * size / 100 / 1e-3
    assert fell["log_scales"][:2].flatten().tolist() == pytest.approx([expected] * 6, rel=1e-3)
    assert not fell["means"].any() and not fell["quats"].any()
    assert not fell["opacity_logits"][2].any() and not fell["log_scales"][2].any()  # not seen


def test_a_small_gradient_makes_it_strong_and_the_clip_bounds_it():
    strong = fall(DecoupledDecay(**START), *stepped(gradient=1e-5))["opacity_logits"][0, 0]
    weak = fall(DecoupledDecay(**START), *stepped(gradient=1e-4))["opacity_logits"][0, 0]
    assert strong.item() == pytest.approx(10 * weak.item(), rel=1e-2)
    bounded = fall(DecoupledDecay(clip=2.0, **START), *stepped(gradient=1e-12))["opacity_logits"][0, 0]
    assert bounded.item() == pytest.approx(2.0 * 0.05, rel=1e-4)


def test_each_has_its_steps():
    rule = DecoupledDecay(opacity=1.0, size=1.0, opacity_start=10, size_start=5, stop=20)
    acted = {}
    for step in (4, 5, 9, 10, 19, 20):
        fell = fall(rule, *stepped(), step=step)
        acted[step] = (bool(fell["opacity_logits"].any()), bool(fell["log_scales"].any()))
    none, size, both = (False, False), (False, True), (True, True)
    assert acted == {4: none, 5: size, 9: size, 10: both, 19: both, 20: none}


def test_frozen_tensors_do_not_decay():
    cloud, optimizer = stepped()
    cloud["opacity_logits"].grad = None
    assert not fall(DecoupledDecay(**START), cloud, optimizer)["opacity_logits"].any()


def test_a_negative_rate_is_refused():
    with pytest.raises(ValueError, match="must not be negative"):
        DecoupledDecay(opacity=-math.inf)
    with pytest.raises(ValueError, match="stop are steps of 0 or more, got 3000, 1000 and -1"):
        DecoupledDecay(stop=-1)


def test_a_finer_render_counts_the_pixels_of_the_training_image(tmp_path, monkeypatch):
    """Over which its loss is a mean."""
    counted = []
    monkeypatch.setattr(DecoupledDecay, "__call__", lambda self, *given: counted.append(given[2]))
    module, _ = run(tmp_path, *BARE, "method=direct_3dgs", "density=fixed", "optim=adamw", "max_steps=1")
    camera = module.scene.train.frames[0].camera
    assert module.supersample > 1 and counted == [camera.width * camera.height]
