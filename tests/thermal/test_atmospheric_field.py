"""The atmospheric field of Thermal3D-GS: its formula, its bounds, what learns, and how TI-3DGS's field extends it."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ViewSet
from heatsplat.splats import Splats
from heatsplat.thermal.atmospheric_field import AtmosphericField, octaves
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.imaging_field import ImagingField
from heatsplat.thermal.static import Static

CAMERA = Camera(torch.eye(4), torch.eye(3), 8, 8)


def make_scene(times=(5.0, 10.0, 45.0)):
    frames = [Frame(f"{i}.png", i, CAMERA, t) for i, t in enumerate(times)]
    views = ViewSet(frames, lambda index: None)
    points = torch.randn(200, 3, generator=torch.Generator().manual_seed(5)) * 3.0 + 7.0
    return SceneData("room", views, views.subset([0]), views.subset([1]), points)


def make(count=40, disturb=0.0, kind=AtmosphericField, **options):
    """A field on a scene with its splats; ``disturb`` gives the last layer random weights of that size."""
    model = kind(Static(), **options)
    model.prepare(make_scene())
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator) * 3.0 + 7.0
    declared = model.per_gaussian(Seeds(means, torch.rand(count, 1, generator=generator), generator))
    geometry = {"means": means, "log_scales": torch.zeros(count, 3), "quats": torch.ones(count, 4)}
    tensors = {name: item.initial for name, item in declared.items()} | geometry
    if disturb:
        with torch.no_grad():
            model.head.weight.normal_(0.0, disturb, generator=torch.Generator().manual_seed(3))
    return model, Splats(tensors | {"opacity_logits": torch.zeros(count, 1)})


def query(time_s=20.0, ids=None):
    return Query(ids=ids, camera=CAMERA, time_s=time_s, frame_id=0)


def by_hand(model, means, time_s):
    """The factor in double precision, layer by layer: a plain perceptron on the code of place and of time, side by side."""
    place = octaves(((means.double() - model.box.center) / model.box.edge).clamp(-0.9, 0.9), model.position_frequencies)
    moment = octaves(torch.tensor([[(time_s - 5.0) / 40.0]], dtype=torch.float64), model.time_frequencies)
    moment[:, [k % model.time_frequencies >= model.slow_octaves for k in range(moment.shape[1])]] = 0.0
    code = torch.cat((place, moment.expand(len(place), -1)), 1)
    hidden = code
    for i, layer in enumerate(model.layers):
        weight = layer.weight.double()
        if str(i) in model.moment_layers:  # this layer sees the code, behind what comes from the layer before
            weight = torch.cat((weight, model.moment_layers[str(i)].weight.double()), 1)
            hidden = code if i == 0 else torch.cat((hidden, code), 1)
        hidden = (hidden @ weight.T + layer.bias.double()).relu()
    absorption, scattering, distance = (hidden @ model.head.weight.double().T + model.head.bias.double()).unbind(1)
    return torch.exp(-4 * torch.tanh((absorption + scattering) * distance / 4))


@pytest.mark.parametrize("options", [{}, {"depth": 4, "skip": 2}])
def test_the_factor_is_the_formula_of_a_plain_network_in_double_precision(options):
    model, splats = make(disturb=0.5, **options)
    expected = by_hand(model, splats.means.detach(), 20.0)
    assert expected.std() > 0.05
    assert torch.allclose(model.factor(splats.means, query()).double(), expected, atol=2e-5)


@pytest.mark.parametrize("exponent", ["printed", "positive"])
def test_it_is_exactly_absent_at_first(exponent):
    model, splats = make(exponent=exponent)
    assert torch.equal(model.features(splats, query()), model.emission.features(splats, query()))


def test_more_of_anything_weakens():
    model, splats = make(8)
    for i in (0, 1):
        with torch.no_grad():
            model.head.bias.copy_(torch.tensor([0.3, 0.3, 1.0]))
            model.head.bias[i] += 0.5
        assert model.factor(splats.means, query())[0].item() == pytest.approx(math.exp(-4 * math.tanh(1.1 / 4)))


@settings(max_examples=30, deadline=None)
@given(scale=st.floats(0.0, 1e18), limit=st.floats(0.1, 4.0), seed=st.integers(0, 100))
def test_factor_and_slopes_are_finite_whatever_the_network_says(scale, limit, seed):
    model, splats = make(20, exponent_max=limit)
    with torch.no_grad():
        model.head.weight.normal_(0.0, 1.0, generator=torch.Generator().manual_seed(seed)).mul_(scale)
    factor = model.factor(splats.means, query())
    factor.sum().backward()
    assert (factor >= math.exp(-limit) * (1 - 1e-5)).all() and (factor <= math.exp(limit) * (1 + 1e-5)).all()
    assert all(parameter.grad.isfinite().all() for parameter in model.layers.parameters())


def test_places_get_no_gradient_and_the_network_does_from_the_first_step_on():
    model, splats = make()
    model.features(splats, query()).sum().backward()
    assert splats.means.grad is None and model.head.weight.grad.abs().max() > 0


def test_only_gaussians_in_view_are_evaluated():
    model, splats = make(50, disturb=0.3)
    rows = []
    model.head.register_forward_hook(lambda module, inputs, output: rows.append(output.shape[0]))
    ids = torch.tensor([4, 17, 3])
    some = model.features(splats, query(ids=ids))
    every = model.features(splats, query())
    assert rows == [3, 50] and torch.allclose(some, every[ids], atol=1e-6)


def test_the_field_of_ti3dgs_adds_a_sensitivity_and_nothing_else():
    field, splats = make(exponent="positive", disturb=0.4)
    imaging, _ = make(kind=ImagingField, exponent="positive", disturb=0.4)
    assert (field.head.out_features, imaging.head.out_features) == (3, 4)
    with torch.no_grad():
        imaging.head.weight[:3], imaging.head.weight[3] = field.head.weight, 0.0
    assert torch.allclose(imaging.factor(splats.means, query()), field.factor(splats.means, query()), rtol=1e-6)
    field.features(splats, query())
    imaging.features(splats, query())
    assert set(imaging.regularisers(splats)) == {"sensitivity_gauge"} and field.regularisers(splats) == {}
    assert set(field.attributes(splats, query())) == {"transmission"}


def test_the_record_is_that_of_the_training_views():
    assert make_scene().record == (5.0, 40.0)
    assert make_scene((3.0, 3.0)).record == (3.0, 1.0)
    with pytest.raises(SceneError, match="'room' has training views without a time"):
        _ = make_scene((None, None)).record


def test_what_it_cannot_do_without_is_named():
    with pytest.raises(ValueError, match="exponent must be one of positive, printed, got 'free'"):
        AtmosphericField(Static(), exponent="free")
    with pytest.raises(SceneError, match="AtmosphericField needs time"):
        AtmosphericField(Static(), time="seconds").check(make_scene((None, None)))
    model, splats = make()
    with pytest.raises(ValueError, match="give time_s"):
        model.features(splats, query(None))


def test_it_learns_air_that_thickens_which_no_constant_can():
    model, splats = make(30)
    with torch.no_grad():
        splats["sh0"].fill_(1.0)  # an emission of 0.78
    times = (5.0, 25.0, 45.0)
    optimiser = torch.optim.Adam([*model.parameters(), *splats.parameters()], lr=3e-3)
    for _ in range(150):
        optimiser.zero_grad()
        misses = [model.features(splats, query(t))[:, 0] - 0.8 * math.exp(-0.02 * (t - 5.0)) for t in times]
        loss = torch.cat(misses).abs().mean()
        loss.backward()
        optimiser.step()
    assert loss.item() < 0.02  # one value for all three times misses by 0.15
