"""Codes of images and Gaussians: no change at first, none in a view that no one took, and what they cost."""

import pytest
import torch
from running import TINY, run

from heatsplat.contracts import Camera
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.embedded import Embedded
from heatsplat.thermal.static import Static


class Scene:
    def __init__(self):
        self.train = type("Views", (), {"frames": [type("Frame", (), {"frame_id": i})() for i in (3, 5, 9)]})()
        self.thermal_range = None


def make_model():
    generator = torch.Generator().manual_seed(0)
    model = Embedded(Static(floor=False))
    model.prepare(Scene())
    means, values = torch.randn(8, 3, generator=generator), torch.rand(8, 1, generator=generator)
    tensors = model.per_gaussian(Seeds(means, values, generator))
    shape = {"log_scales": torch.zeros(8, 3), "quats": torch.ones(8, 4), "opacity_logits": torch.zeros(8, 1)}
    return model, Splats({name: part.initial for name, part in tensors.items()} | {"means": means} | shape), values


def seen(model, splats, frame_id):
    camera = Camera(torch.eye(4), torch.eye(3), 8, 8)
    return model.features(splats, Query(None, camera, None, frame_id)).detach()


def test_nothing_changes_before_training_and_images_differ_after():
    model, splats, values = make_model()
    for frame_id in (3, 5, 9, None):
        assert torch.allclose(seen(model, splats, frame_id), values, atol=1e-6)
    with torch.no_grad():
        model.head.weight.normal_(generator=torch.Generator().manual_seed(1))
    assert not torch.allclose(seen(model, splats, 3), seen(model, splats, 9), atol=1e-3)
    assert torch.equal(seen(model, splats, 77), seen(model, splats, None))  # never trained on: the mean code
    assert (seen(model, splats, 3) - values).abs().max() <= 0.5 * (1 + values.max())


def test_what_codes_cost_is_their_spread_alone():
    model, splats, _ = make_model()
    with torch.no_grad():
        model.codes.copy_(torch.tensor([1.0, 2.0, 3.0])[:, None].expand(3, 16))
    assert model.regularisers(splats)["codes"].item() == pytest.approx(1e-3 * 2 / 3)


def test_a_run_gives_every_image_a_code_of_its_own(tmp_path):
    module, _ = run(tmp_path, *TINY, "method=wild_thermal", "max_steps=60", "test=false")
    codes = module.thermal.codes
    assert len(codes) == len(module.scene.train) and codes.std(0).min() > 0.01
    assert module.thermal.head.weight.abs().max() > 0
