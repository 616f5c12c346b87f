"""Thermal models of more Gaussians than torch leaves to one thread: the same bits for any number of threads."""

import math
from copy import deepcopy

import pytest
import torch
from threads import with_threads

from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, ViewSet, Weather
from heatsplat.splats import Splats
from heatsplat.thermal.attenuation import Attenuation
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.common_source import CommonSource
from heatsplat.thermal.composed import Composed
from heatsplat.thermal.conduction import Conducting
from heatsplat.thermal.directional_emissivity import DirectionalEmissivity
from heatsplat.thermal.energy_balance import EnergyBalance
from heatsplat.thermal.imaging_field import ImagingField
from heatsplat.thermal.layers import Head
from heatsplat.thermal.mirrored_sky import MirroredSky
from heatsplat.thermal.newton_harmonic import NewtonHarmonic
from heatsplat.thermal.radiative import Radiative
from heatsplat.thermal.radiative_transfer import RadiativeTransfer
from heatsplat.thermal.reflection import Reflection
from heatsplat.thermal.static import Static
from heatsplat.thermal.through_air import ThroughAir

COUNT = 70_001  # shares of threads end inside vectors
HOUR = 3600.0
MODELS = {
    "air": lambda: Composed(Static(floor=False), {"air": Attenuation(moments=3)}),
    "through air": lambda: ThroughAir(Static(floor=False), Attenuation(moments=3)),
    "common source": lambda: CommonSource(moments=5),
    "harmonics": lambda: NewtonHarmonic(frequencies=4),
    "even surroundings": lambda: Composed(Static(floor=False), {"mirror": Reflection(degree=0)}),
    "surroundings": lambda: Composed(Static(floor=False), {"mirror": Reflection(degree=2)}),
    "sky": lambda: Composed(Static(floor=False), {"mirror": MirroredSky(), "angle": DirectionalEmissivity()}),
    "grey bodies": lambda: Radiative(Static(channels=3, modality="rgb")),
    "bodies in a band": lambda: Radiative(
        Static(channels=3, modality="rgb"), law="band", three_parameter=True, reflectance="kirchhoff"
    ),
    "radiative transfer": lambda: RadiativeTransfer(Static(floor=False), Attenuation(moments=0)),
    "conduction": lambda: Conducting(Static(floor=False), flow=2.0),
    "imaging field": lambda: ImagingField(Static(), exponent="printed"),
    "imaging field of positive coefficients": lambda: ImagingField(Static(), exponent="positive"),
    "balance": lambda: EnergyBalance(materials=8),
    "linear balance": lambda: EnergyBalance(solution="linear", materials=8),
}
MEASURED = {"sky", "bodies in a band"}  # air temperatures that others learn


def random(*shape, seed=0):
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed))


def camera():
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = torch.tensor([0.1, -0.2, 4.0])
    return Camera(viewmat, torch.eye(3), 8, 8)


def scene(ambient_c):
    times = torch.arange(0.0, 37 * HOUR, HOUR, dtype=torch.float64)
    day = 2 * math.pi * times / (24 * HOUR)
    sun = torch.nn.functional.normalize(torch.stack((day.sin(), day.cos() - 1.5, 0.5 - day.cos()), dim=1), dim=1)
    height = sun[:, 2].clamp(min=0.0)
    weather = Weather(
        times, air_c=16 - 6 * day.cos(), wind_m_s=3 - 2 * day.cos(), humidity_percent=60 + 20 * day.cos(),
        irradiance_w_m2=800 * height, direct_w_m2=700 * (height > 0).double(), diffuse_w_m2=100 * height, sun=sun,
    )  # fmt: skip
    frames = [Frame(f"{i}.png", i, camera(), 3 * HOUR * i) for i in range(12)]
    views = ViewSet(frames, lambda i: None)
    return SceneData(
        "yard", views, views, views, random(400, 3, seed=3), None, ThermalRange(0.0, 60.0), ambient_c, weather=weather
    )


@pytest.mark.parametrize("name", MODELS)
def test_a_model_gives_and_learns_the_same_bits(name):
    model = MODELS[name]()
    model.prepare(scene(20.0 if name in MEASURED else None))
    count = sum(model.modality_channels)
    values = 0.4 + 0.1 * random(COUNT, count).clamp(-3, 3)
    declared = model.per_gaussian(Seeds(random(COUNT, 3, seed=1), values, torch.Generator().manual_seed(0)))
    tensors = {part: item.initial + 0.05 * random(*item.initial.shape, seed=2) for part, item in declared.items()}
    if "normals" in tensors:
        tensors["normals"] = torch.nn.functional.normalize(random(COUNT, 3, seed=4), dim=1)
    with torch.no_grad():
        for seed, parameter in enumerate(model.parameters()):
            parameter.add_(0.05 * random(*parameter.shape, seed=seed))
    shape = {"means": random(COUNT, 3, seed=1), "log_scales": random(COUNT, 3) - 3, "quats": random(COUNT, 4)}
    splats = Splats(tensors | shape | {"opacity_logits": torch.zeros(COUNT, len(model.opacity_channels))})
    query, pull = Query(None, camera(), 14.2 * HOUR, 3), random(COUNT, count, seed=5)

    def results():
        own, found = deepcopy(model), {}  # the means of materials move with every call
        learned = dict(own.named_parameters()) | {name: splats[name] for name in splats.names}
        for k, weights in enumerate((pull, pull.exp(), pull.square())):  # of which one alone may round alike by chance
            seen = own.features(splats, query)
            terms = [(seen * weights).sum() / COUNT, *own.regularisers(splats).values()]
            slopes = torch.autograd.grad(sum(terms), list(learned.values()), allow_unused=True)
            found |= {f"seen {k}": seen.detach()} | {f"{name} {k}": x for name, x in zip(learned, slopes, strict=True)}
        return found

    one, *others = with_threads((1, 2, 3, 5, 7), results)
    one = {name: found for name, found in one.items() if found is not None}
    assert {f"{name} 0" for name, _ in model.named_parameters()} <= set(one)
    for other in others:
        assert not [name for name, found in one.items() if not torch.equal(found, other[name])]


@pytest.mark.parametrize("outputs", [1, 2])
def test_the_bias_of_a_network_learns_the_same_bits(outputs):
    head, values = Head(16, outputs), random(COUNT // 5, 5, 16)
    assert torch.equal(head(values), torch.nn.functional.linear(values, head.weight, head.bias))
    pull = random(COUNT // 5, 5, outputs, seed=1)
    one, *others = with_threads((1, 2, 3, 5, 7), lambda: torch.autograd.grad((head(values) * pull).sum(), head.bias)[0])
    # Pulls of both signs cancel, and torch's own sum depends on the threads: what is right comes from float64.
    exact = pull.double().sum((0, 1))
    torch.testing.assert_close(one.double(), exact, rtol=0, atol=1e-8 * float(pull.abs().sum()))
    assert all(torch.equal(one, other) for other in others)
