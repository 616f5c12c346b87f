"""A scene through air: the law, that the truth of a foggy scene is found, and what is told of it."""

import pytest
import torch
from running import BARE, run

from heatsplat.contracts import Camera
from heatsplat.datamodules.synthetic_scene.presets import droplets
from heatsplat.splats import Splats
from heatsplat.thermal.attenuation import Attenuation
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.static import Static
from heatsplat.thermal.through_air import ThroughAir


def test_emission_fades_to_the_air_with_the_true_distance():
    model = ThroughAir(Static(floor=False), Attenuation(depth=0.3, moments=0))
    generator = torch.Generator().manual_seed(0)
    means, values = torch.randn(20, 3, generator=generator), torch.rand(20, 1, generator=generator)
    tensors = model.per_gaussian(Seeds(means, values, generator))
    shape = {"log_scales": torch.zeros(20, 3), "quats": torch.ones(20, 4), "opacity_logits": torch.zeros(20, 1)}
    splats = Splats({name: part.initial for name, part in tensors.items()} | {"means": means} | shape)
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([0.2, -0.1, 3.0])
    seen = model.features(splats, Query(None, Camera(viewmat, torch.eye(3), 8, 8)))
    farther = (means + torch.tensor([0.2, -0.1, 3.0])).norm(dim=1, keepdim=True) - 1.0  # than the typical distance
    assert torch.allclose(seen, 0.5 + (values - 0.5) * torch.exp(-0.3 * farther), atol=1e-5)  # air at 1/2, unmeasured
    assert set(model.effects()) == {"attenuation"}
    assert {name for name, _ in model.named_parameters()} == {"air.log_depth"}


def test_an_unknown_way_to_clip_is_refused():
    with pytest.raises(ValueError, match="clip"):
        ThroughAir(Static(), Attenuation(), clip="soft")


def test_a_run_finds_the_extinction_of_the_fog(tmp_path):
    module, _ = run(tmp_path, *BARE, "method=through_air", "data.scene=fog", "max_steps=450", "sensor=none")
    extinction = module.thermal.air.extinction().item()
    assert extinction == pytest.approx(droplets(2.0), rel=0.25)
    points, _ = module.scene.probes[:, :3], module.scene.probes
    nearest = torch.cdist(points.double(), module.splats.means.detach().double()).argmin(1)
    found = module.thermal.temperature(module.splats, 100.0).detach()[nearest] - 273.15
    true = module.scene.truth(points, torch.tensor([100.0]))[:, 0]
    seen = 22.0 + (true - 22.0) * torch.exp(-droplets(2.0) * module.thermal.air.typical)
    assert (found - true).abs().median() < 0.4 * (seen - true).abs().median()
