"""NTR-Gaussian: the integral against closed forms and a fine rule, its stages, its penalties, its gradients."""

import math
from dataclasses import replace

import pytest
import torch
from weathered import CAMERA, HOUR_S, make_scene

from heatsplat.contracts import SceneError, ThermalRange
from heatsplat.physics.units import KELVIN_AT_0_C, STEFAN_BOLTZMANN
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.ntr_gaussian import EXCHANGE, STORAGE, NtrGaussian


def make(count=30, **options):
    model, scene = NtrGaussian(**{"width": 16} | options), make_scene()
    model.prepare(scene)
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) * 4.0
    declared = model.per_gaussian(Seeds(means, torch.rand(count, 1, generator=generator), generator))
    geometry = {
        "means": means,
        "log_scales": torch.zeros(count, 3),
        "quats": torch.randn(count, 4, generator=generator),
    }
    tensors = {name: item.initial for name, item in declared.items()} | geometry
    return model, Splats(tensors | {"opacity_logits": torch.zeros(count, 1)}), scene


def at(time_s, ids=None):
    return Query(ids=ids, camera=CAMERA, time_s=time_s)


def steady(model, units=None):
    """Turns the networks into constants: T_net everywhere ``units``, materials with all raw outputs zero."""
    with torch.no_grad():
        model.attribute_heads.zero_()
        for layer in (model.temperature_head, model.env[-1]):
            layer.weight.zero_()
            layer.bias.zero_()
        if units is not None:
            model.temperature_head.bias.fill_(math.log(units / (1 - units)))


def test_a_steady_balance_integrates_exactly():
    """With constant networks T = T_net - window [e σ T⁴ + h (T - T_env)] / c, whatever the number of nodes."""
    for nodes in (2, 6, 13):
        model, splats, scene = make(nodes=nodes, window_s=1800.0)
        steady(model, units=0.7)
        model.eval()
        low, span = scene.thermal_range.min_c + KELVIN_AT_0_C, scene.thermal_range.span_k
        flux = 0.5 * STEFAN_BOLTZMANN * (low + 0.7 * span) ** 4 + EXCHANGE * math.log(2.0) * 0.2 * span
        window = min(1800.0, 2 * HOUR_S)
        expected = low + 0.7 * span - window * flux / (STORAGE * (math.log(2.0) + 0.05))
        found = model.range.kelvin(model._units(splats, None, 2 * HOUR_S))
        assert torch.allclose(found, torch.full_like(found, expected), atol=2e-3)


def test_a_checkpoint_shows_the_same_where_the_data_are_divided_in_another_way():
    trained, splats, scene = make(window_s=HOUR_S)
    halved = replace(scene, thermal_range=ThermalRange(20.0, 22.0))
    trained.prepare(halved)
    later, _, _ = make(window_s=HOUR_S)
    few = [i for i, time_s in enumerate(scene.train.times_s) if time_s <= 0.5 * HOUR_S]
    later.prepare(replace(halved, train=scene.train.subset(few)))
    later.load_state_dict(trained.state_dict())
    assert torch.equal(later.temperature(splats, HOUR_S), trained.temperature(splats, HOUR_S))


def test_more_nodes_converge_at_second_order():
    errors = []
    model, splats, _ = make(frames_per_cycle=None)
    exact = None
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.mul_(0.5)
        model.attribute_heads.normal_(0.0, 0.5, generator=torch.Generator().manual_seed(2))
        model.time_frequencies, model.moment.weight[:, 2:] = model.time_frequencies, 0.0  # one smooth octave of time
        model.env[0].weight[:, 2:] = 0.0
        model.of_state.weight[:, 5:] = 0.0
        for nodes in (1025, 9, 17, 33):
            model.nodes = nodes
            found = model._units(splats, None, 2 * HOUR_S).double()
            exact = found if exact is None else exact
            errors.append((found - exact).abs().max().item())
    orders = [math.log2(errors[i] / errors[i + 1]) for i in (1, 2)]
    assert all(1.6 < order < 2.4 for order in orders), (errors, orders)


def test_the_first_stage_emits_a_value_per_gaussian_and_the_second_the_integral():
    model, splats, _ = make(first_steps=5)
    model.on_step(0)
    first = model.features(splats, at(HOUR_S))[:, 0]
    assert torch.equal(first, splats["first_value"].clamp(min=0)) and model.regularisers(splats) == {}
    model.on_step(5)
    assert not torch.equal(model.features(splats, at(HOUR_S))[:, 0], first)
    assert "first_value" not in make()[1].names


def test_only_the_asked_gaussians_are_evaluated():
    model, splats, _ = make()
    model.eval()
    ids = torch.tensor([3, 17, 4])
    every = model.features(splats, at(HOUR_S))
    assert torch.allclose(model.features(splats, at(HOUR_S, ids)), every[ids], atol=1e-6)


def test_the_ends_of_the_record_are_held_beyond_it():
    model, splats, scene = make()
    with torch.no_grad():
        model.temperature_head.weight.normal_(generator=torch.Generator().manual_seed(2))
    first, last = scene.record[0], sum(scene.record)
    assert torch.equal(model.features(splats, at(last + 3600.0)), model.features(splats, at(last)))
    assert torch.equal(model.features(splats, at(first - 3600.0)), model.features(splats, at(first)))
    assert not torch.equal(model.features(splats, at(first)), model.features(splats, at(last)))


def test_hours_come_again_where_the_weather_goes_on_for_more_than_a_day():
    model, splats, scene = make(time="day")
    with torch.no_grad():
        model.temperature_head.weight.normal_(generator=torch.Generator().manual_seed(2))
    noon, next_noon, evening = (model.features(splats, at(hours * HOUR_S)) for hours in (6, 30, 12))
    torch.testing.assert_close(noon, next_noon)
    assert not torch.allclose(noon, evening, atol=1e-3)
    for days in (0.9, 2.0):
        model.time, times = "scene", scene.weather.times_s
        stretch = days * 24 * HOUR_S / float(times[-1] - times[0])
        model.prepare(replace(scene, weather=replace(scene.weather, times_s=times[0] + stretch * (times - times[0]))))
        assert bool(model.daily) == (days > 1)


def test_penalties_are_there_with_gradients_and_absent_at_weight_zero():
    model, splats, _ = make()
    loss = model.features(splats, at(2 * HOUR_S)).sum()
    terms = model.regularisers(splats)
    assert set(terms) == {"ntr/consistency", "ntr/environment", "ntr/variation", "ntr/integral"}
    (loss + sum(terms.values())).backward()
    tensors = dict(model.named_parameters()) | {"feature": splats["feature"]}
    gradients = {name: tensor.grad for name, tensor in tensors.items()}
    idle = {name for name, grad in gradients.items() if grad is None or not grad.isfinite().all()}
    assert not idle

    assert model.regularisers(splats) == {}  # of the last evaluation only
    silent, splats, _ = make(consistency=0.0, integral=0.0)
    silent.features(splats, at(2 * HOUR_S))
    assert set(silent.regularisers(splats)) == {"ntr/environment", "ntr/variation"}


def test_cost_and_effects_are_told():
    assert make()[0].cost < make(width=64)[0].cost
    assert set(make()[0].effects()) == {"relaxation", "radiation", "convection"}


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match="nodes must be at least 2"):
        NtrGaussian(nodes=1)
    for name in ("first_steps", "consistency", "environment", "variation", "integral"):
        with pytest.raises(ValueError, match=f"{name}.* must not be negative, got .*-1"):
            NtrGaussian(**{name: -1})
    with pytest.raises(SceneError, match="NtrGaussian needs time, which scene"):
        NtrGaussian().check(make_scene(times=(None, None, None)))


def test_attribute_networks_are_normalised_and_learn_at_their_own_rate():
    model, splats, _ = make(normalised=True, lr_attributes=1.6e-2, lr=1e-3)
    rates = {name: model.rate_of(name).lr for name, _ in model.named_parameters()}
    fast = {name for name, rate in rates.items() if rate == 1.6e-2}
    assert {name.split(".")[0] for name in fast} == {
        "of_feature",
        "of_place",
        "of_state",
        "attribute_heads",
        "attribute_norm",
    }
    with torch.no_grad():
        model.attribute_heads.fill_(1.0)
        before = model.features(splats, at(HOUR_S))
        model.of_state.weight.mul_(50.0)  # of normalised values only their pattern counts
        model.of_state.bias.mul_(50.0)
        model.of_feature.weight.mul_(50.0)
        model.of_feature.bias.mul_(50.0)
        model.of_place.weight.mul_(50.0)
        model.of_place.bias.mul_(50.0)
        torch.testing.assert_close(model.features(splats, at(HOUR_S)), before, rtol=1e-3, atol=1e-4)
    plain, _, _ = make()
    assert not any("norm" in name for name, _ in plain.named_parameters())
