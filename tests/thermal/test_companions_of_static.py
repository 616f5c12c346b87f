"""The static model with companions: what two models of one image each would emit, on the same Gaussians."""

import pytest
import torch

from heatsplat.contracts import Camera, SceneData, ThermalRange, ViewSet
from heatsplat.physics.units import KELVIN_AT_0_C
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.static import Static

COUNT = 40


def camera():
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = 4.0
    return Camera(viewmat, torch.eye(3, dtype=torch.float64), 8, 8)


def seeds():
    generator = torch.Generator().manual_seed(0)
    return Seeds(torch.randn(COUNT, 3, generator=generator), torch.rand(COUNT, 4, generator=generator), generator)


def splats_of(means, tensors):
    geometry = {"means": means, "log_scales": torch.zeros(COUNT, 3), "quats": torch.ones(COUNT, 4)}
    return Splats(geometry | {"opacity_logits": torch.zeros(COUNT, 1)} | tensors)


@pytest.mark.parametrize("degree", [0, 3])
def test_channels_are_those_of_two_models(degree):
    both, start = Static(degree, companions={"rgb": 3}), seeds()
    assert both.modality_channels == (1, 3) and both.companions == ("rgb",) and both.opacity_channels == (4,)
    tensors = {name: part.initial for name, part in both.per_gaussian(start).items()}
    if degree:
        tensors["sh_rest"] = 0.3 * torch.randn(COUNT, 15, 4, generator=torch.Generator().manual_seed(1))
    emitted = both.features(splats_of(start.means, tensors), Query(camera=camera()))
    for model, part in ((Static(degree), slice(0, 1)), (Static(degree, 3, "rgb"), slice(1, 4))):
        own = {name: tensor[..., part] for name, tensor in tensors.items()}
        expected = model.features(splats_of(start.means, own), Query(camera=camera()))
        assert torch.equal(emitted[:, part], expected)
    if degree == 0:
        assert torch.allclose(emitted, start.values, atol=1e-6)


def test_temperature_is_that_of_the_thermal_channel():
    empty = ViewSet([], lambda index: None)
    scene = SceneData("room", empty, empty, empty, torch.zeros(4, 3), thermal_range=ThermalRange(10.0, 30.0))
    model, start = Static(companions={"rgb": 3}), seeds()
    model.prepare(scene)
    tensors = {name: part.initial for name, part in model.per_gaussian(start).items()}
    kelvin = model.temperature(splats_of(start.means, tensors), 0.0)
    assert torch.allclose(kelvin.float(), 10 + 20 * start.values[:, 0] + KELVIN_AT_0_C, atol=1e-3)


def test_opacities_of_their_own_on_request_and_no_image_twice():
    assert Static(companions={"rgb": 3}, shared_opacity=False).opacity_channels == (1, 3)
    assert Static(shared_opacity=False).opacity_channels == Static().opacity_channels == (1,)
    with pytest.raises(ValueError, match="leave rgb out of them"):
        Static(channels=3, modality="rgb", companions={"rgb": 3})
    with pytest.raises(ValueError, match="companions must be one of thermal, rgb, got 'depth'"):
        Static(companions={"depth": 1})
