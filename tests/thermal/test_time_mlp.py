"""ThermalGS-style: ΔT is absent at first, what a plain network gives in double precision, and learns a curve of time."""

import math

import pytest
import torch

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ThermalRange, ViewSet
from heatsplat.physics.units import KELVIN_AT_0_C
from heatsplat.splats import Splats
from heatsplat.thermal.atmospheric_field import octaves
from heatsplat.thermal.base import Query, Rate, Seeds
from heatsplat.thermal.static import Static
from heatsplat.thermal.time_mlp import TimeMlp

CAMERA = Camera(torch.eye(4), torch.eye(3), 8, 8)


def make_scene(times=(10.0, 20.0, 50.0)):
    views = ViewSet([Frame(f"{i}.png", i, CAMERA, t) for i, t in enumerate(times)], lambda index: None)
    return SceneData("yard", views, views, views, torch.rand(50, 3), thermal_range=ThermalRange(10.0, 30.0))


def make(count=30, disturb=0.0, **options):
    """A model on a scene with its splats; ``disturb`` gives the last layer random weights of that size."""
    model = TimeMlp(Static(floor=False), **options)
    model.prepare(make_scene())
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator)
    declared = model.per_gaussian(Seeds(means, torch.rand(count, 1, generator=generator), generator))
    geometry = {"means": means, "log_scales": torch.zeros(count, 3), "quats": torch.ones(count, 4)}
    tensors = {name: item.initial for name, item in declared.items()} | geometry
    if disturb:
        with torch.no_grad():
            model.head.weight.normal_(0.0, disturb, generator=torch.Generator().manual_seed(3))
    return model, Splats(tensors | {"opacity_logits": torch.zeros(count, 1)})


def query(time_s=20.0, ids=None):
    return Query(ids=ids, camera=CAMERA, time_s=time_s, frame_id=0)


def test_it_is_exactly_3dgs_at_first_also_below_zero():
    model, splats = make()
    with torch.no_grad():
        splats["sh0"][:5] = -3.0
    assert torch.equal(model.features(splats, query()), Static().features(splats, query()))


def test_the_change_is_that_of_a_plain_network_in_double_precision():
    model, splats = make(disturb=0.5)
    share = torch.tensor([[0.25]], dtype=torch.float64)
    weights = {name: parameter.detach().double() for name, parameter in model.named_parameters()}
    moment = torch.cat((share, octaves(share, 4)), 1)
    code = (moment @ weights["moment.weight"].T + weights["moment.bias"]).relu()
    code = code @ weights["code.weight"].T + weights["code.bias"]
    joint = torch.cat((splats["feature"].detach().double(), code.expand(30, -1)), 1)  # [feature, time code]
    first = torch.cat((weights["of_feature.weight"], weights["of_code.weight"]), 1)
    hidden = (joint @ first.T + weights["of_feature.bias"]).relu()
    hidden = (hidden @ weights["hidden.weight"].T + weights["hidden.bias"]).relu()
    expected = (hidden @ weights["head.weight"].T)[:, 0] + weights["head.bias"]
    assert expected.abs().max() > 0.05
    assert torch.allclose(model.change(splats["feature"], 20.0).double(), expected, atol=1e-6)
    level = model.emission.features(splats, query())[:, 0].double()
    assert torch.allclose(model.features(splats, query())[:, 0].double(), (level + expected).clamp(min=0), atol=1e-6)
    found = model.temperature(splats, 20.0).double()
    assert torch.allclose(found, KELVIN_AT_0_C + 10.0 + 20.0 * (level + expected), atol=1e-3)


def test_only_gaussians_in_view_are_evaluated_and_the_time_once():
    model, splats = make(disturb=0.3)
    rows = []
    for layer in (model.head, model.code):
        layer.register_forward_hook(lambda module, inputs, output: rows.append(output.shape))
    ids = torch.tensor([4, 17, 3])
    some = model.features(splats, query(ids=ids))
    assert rows == [(16,), (3, 1)]
    assert torch.allclose(some, model.features(splats, query())[ids], atol=1e-6)


def test_the_first_stage_evaluates_nothing_and_learns_no_network():
    model, splats = make(first_steps=5, disturb=0.3)
    calls = []
    model.head.register_forward_hook(lambda *_: calls.append(1))
    model.on_step(4)
    emitted = model.features(splats, query())
    emitted.sum().backward()
    assert not calls and torch.equal(emitted, Static().features(splats, query()))
    assert splats["feature"].grad is None and all(parameter.grad is None for parameter in model.parameters())
    assert torch.equal(model.temperature(splats, 20.0), model.emission.temperature(splats, 20.0))
    model.on_step(5)
    model.features(splats, query()).sum().backward()
    assert calls and splats["feature"].grad.abs().max() > 0


def test_every_gaussian_learns_a_curve_of_its_own():
    model, splats = make(20)
    with torch.no_grad():
        splats["sh0"].zero_()
    times = torch.linspace(10.0, 50.0, 4)
    amplitude = torch.linspace(-0.2, 0.2, 20)
    target = 0.5 + amplitude[:, None] * torch.cos(2 * math.pi * (times - 10.0) / 40.0)
    optimiser = torch.optim.Adam([*model.parameters(), *splats.parameters()], lr=1e-2)
    for _ in range(120):
        optimiser.zero_grad()
        found = torch.cat([model.features(splats, query(t)) for t in times.tolist()], 1)
        loss = (found - target).abs().mean()
        loss.backward()
        optimiser.step()
    assert loss.item() < 0.02  # values that stay miss by 0.07


@pytest.mark.parametrize("time_s", [-1e6, 10.0, 1e9])
@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_values_and_slopes_are_finite_at_any_time_and_feature(time_s, scale):
    model, splats = make(disturb=1.0)
    with torch.no_grad():
        splats["feature"].mul_(scale)
    emitted = model.features(splats, query(time_s))
    emitted.sum().backward()
    assert emitted.isfinite().all() and (emitted >= 0).all() and splats["feature"].grad.isfinite().all()
    assert all(parameter.grad.isfinite().all() for parameter in model.parameters())


def test_rates_needs_and_cost_are_told():
    model, _ = make()
    assert model.needs == {"time"} and model.cost == Static().cost + 16 * 64 + 64 * 64 + 64
    assert model.rate_of("code.weight") == Rate(1e-3, paced=True) and model.rate_of("of_code.weight") == Rate(
        2.5e-3, paced=True
    )
    assert model.per_gaussian(Seeds(torch.zeros(2, 3), torch.rand(2, 1), torch.Generator()))["feature"].lr == 2.5e-3


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="must be at least 1, got 0, 64, 16, 4"):
        TimeMlp(Static(), feature_size=0)
    with pytest.raises(SceneError, match="TimeMlp needs time, which scene 'yard'"):
        TimeMlp(Static()).check(make_scene((None, None)))
    model, splats = make()
    with pytest.raises(ValueError, match="give time_s"):
        model.features(splats, query(None))
