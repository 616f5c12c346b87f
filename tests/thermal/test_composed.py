"""Composed models: what is off is absent, and what each part does."""

import math
from collections import Counter
from dataclasses import replace

import pytest
import torch
from torch.profiler import ProfilerActivity, profile

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ThermalRange, ViewSet
from heatsplat.density.ops import Cloud
from heatsplat.geometry import spherical_harmonics
from heatsplat.splats import Splats
from heatsplat.thermal import conduction
from heatsplat.thermal.attenuation import Attenuation
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.common_source import CommonSource
from heatsplat.thermal.composed import Composed
from heatsplat.thermal.conduction import Conducting, _ImplicitStep, laplacian
from heatsplat.thermal.directional_emissivity import DirectionalEmissivity
from heatsplat.thermal.newton_harmonic import NewtonHarmonic
from heatsplat.thermal.reflection import Reflection
from heatsplat.thermal.static import Static
from heatsplat.thermal.view_dependence import ViewDependence

SPAN_S = 400.0
STATES = {
    "static": lambda **options: Static(**options),
    "relaxation": lambda **options: NewtonHarmonic(frequencies=0, **options),
    "harmonic": lambda **options: NewtonHarmonic(frequencies=4, **options),
    "common": lambda **options: CommonSource(moments=5, **options),
}
OPEN = {"static": {"floor": False}} | dict.fromkeys(("relaxation", "harmonic", "common"), {"clip": "none"})
PARTS = {
    "directional_emissivity": lambda: DirectionalEmissivity(power=1),
    "view_dependence": lambda: ViewDependence(sh_degree_interval=0),
    "reflection": lambda: Reflection(),
    "attenuation": lambda: Attenuation(moments=3),
}


def camera(x=0.0):
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[0, 3], viewmat[2, 3] = -x, 4.0
    return Camera(viewmat, torch.eye(3), 4, 4)


def scene(ambient_c=26.0, timed=True):
    frames = [Frame(f"{i}.png", i, camera(0.1 * i), SPAN_S * i / 40 if timed else None) for i in range(41)]
    views = ViewSet(frames, lambda i: None)
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(3))
    return SceneData("kettle", views, views, views, points, None, ThermalRange(20.0, 70.0), ambient_c)


def seeds(count=40, channels=1):
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator)
    return Seeds(means, 0.2 + 0.6 * torch.rand(count, channels, generator=generator), generator)


def splats_of(model, start=None, disturb=0.3):
    start = start or seeds(channels=sum(model.modality_channels))
    count, generator = len(start.means), torch.Generator().manual_seed(1)
    tensors = {
        "means": start.means,
        "log_scales": torch.randn(count, 3, generator=generator),
        "quats": torch.randn(count, 4, generator=generator),
        "opacity_logits": torch.zeros(count, len(model.opacity_channels)),
    }
    for name, item in model.per_gaussian(start).items():
        shake = torch.Generator().manual_seed(len(name))
        tensors[name] = item.initial + disturb * torch.randn(item.initial.shape, generator=shake)
    return Splats(tensors)


def made(state="harmonic", parts=(), **options):
    model = Composed(
        STATES[state](**(OPEN[state] if parts else {})), {name: PARTS[name]() for name in parts}, **options
    )
    model.prepare(scene())
    return model


def query(time_s=150.0, ids=None):
    return Query(ids, camera(0.3), time_s, 3)


def operators(model, splats):
    """Names of the operators of a forward and backward pass, in order."""
    for parameter in [*model.parameters(), *splats.parameters()]:
        parameter.grad = None  # or a gradient would be added where the first one was put
    with profile(activities=[ProfilerActivity.CPU]) as seen:
        model.features(splats, query()).sum().backward()
    return [event.name for event in seen.events()]


# Off is absent ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", STATES)
def test_without_parts_it_is_the_state_itself(state):
    alone, composed = STATES[state](), made(state, clip="hard")
    alone.prepare(scene())
    splats = splats_of(alone)
    assert splats_of(composed).names == splats.names
    expected, got = alone.features(splats, query()), composed.features(splats, query())
    assert torch.equal(got, expected)
    assert [f"state.{name}" for name, _ in alone.named_parameters()] == [n for n, _ in composed.named_parameters()]
    assert [f"state.{name}" for name, _ in alone.named_buffers()] == [n for n, _ in composed.named_buffers()]
    assert operators(composed, splats) == operators(alone, splats)
    assert composed.cost == alone.cost and composed.effects() == alone.effects()
    assert composed.regularisers(splats) == alone.regularisers(splats)
    told, expected = composed.attributes(splats, query()), alone.attributes(splats, query())
    assert list(told) == list(expected) and all(torch.equal(told[name], expected[name]) for name in told)


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize("off", PARTS)
def test_a_part_that_is_off_leaves_nothing_behind(state, off):
    others = [name for name in PARTS if name != off]
    never, full = made(state, others), made(state, PARTS)
    switched = Composed(STATES[state](**OPEN[state]), {n: None if n == off else PARTS[n]() for n in PARTS})
    switched.prepare(scene())
    splats = splats_of(never)
    assert splats_of(switched).names == splats.names and set(splats_of(full).names) >= set(splats.names)
    for kind in ("named_parameters", "named_buffers"):
        names = [name for name, _ in getattr(switched, kind)()]
        assert names == [name for name, _ in getattr(never, kind)()] and not [name for name in names if off in name]
    assert torch.equal(switched.features(splats, query()), never.features(splats, query()))
    assert operators(switched, splats) == operators(never, splats)
    assert len(operators(full, splats_of(full))) > len(operators(never, splats))
    assert off not in switched.effects() and off in full.effects() and switched.cost < full.cost


def test_without_a_heat_source_there_is_no_tensor_of_one():
    assert "source_gains" not in splats_of(made("relaxation")) and "source_gains" in splats_of(made("harmonic"))


@pytest.mark.parametrize("count", [1, 2, 40])
def test_conduction_knows_few_gaussians_and_double_precision(count):
    model = Conducting(NewtonHarmonic(frequencies=4), flow=5.0)
    model.prepare(scene())
    splats = splats_of(model, seeds(count))
    late = query(SPAN_S)
    single = model.features(splats, late)
    double = model.double().features(splats.to(torch.float64), late)
    assert double.dtype == torch.float64 and torch.allclose(single.double(), double, atol=1e-5)


def test_what_is_said_of_effects_is_said_of_nothing_else():
    full = made("harmonic", PARTS)
    before = full.state.effects()
    told = full.effects()
    assert set(told) > set(before) and full.state.effects() == before


def test_conduction_that_is_off_leaves_the_state_alone():
    alone, with_it = NewtonHarmonic(frequencies=4), Conducting(NewtonHarmonic(frequencies=4))
    alone.prepare(scene())
    with_it.prepare(scene())
    never = made("harmonic")
    splats = splats_of(never)
    assert splats_of(with_it).names == splats_of(alone).names == splats.names
    assert not list(never.parameters()) and {n for n, _ in with_it.named_parameters()} == {"log_flow"}
    extra = {n.removeprefix("state.") for n, _ in with_it.named_buffers()} - {n for n, _ in alone.named_buffers()}
    assert extra == {"edges", "joined"}
    with_it.features(splats, query())  # draws its graph
    expected, seen, more = (operators(model, splats) for model in (alone, never, with_it))
    assert seen == expected
    assert not (Counter(expected) - Counter(more)) and {"_ImplicitStep", "_ImplicitStepBackward"} <= set(more) - set(
        seen
    )


# Parts --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("parts", [(), *[(name,) for name in PARTS], tuple(PARTS)])
def test_gaussians_in_view_get_what_all_get_and_gradients_are_finite(parts):
    model = made("harmonic", parts)
    splats, ids = splats_of(model), torch.tensor([3, 17, 5, 30])
    every = model.features(splats, query())
    some = model.features(splats, query(ids=ids))
    assert torch.allclose(some, every[ids], atol=1e-6)
    assert every.min() >= 0 and every.max() <= 1
    (every.sum() + sum(model.regularisers(splats).values())).backward()
    for name, parameter in [*model.named_parameters(), *splats.raw.named_parameters()]:
        assert parameter.grad is None or parameter.grad.isfinite().all(), name
    assert all(parameter.grad is not None for parameter in model.parts.parameters())


def test_air_dims_what_lies_far_and_shows_its_own_temperature():
    part = Attenuation(depth=0.5)
    part.prepare(scene())
    splats, values = splats_of(made("static")), torch.rand(40, 1)
    distances = (splats.means - camera(0.3).center.float()).norm(dim=1, keepdim=True)
    beta = 0.5 / part.typical.item()
    expected = 0.12 + (values - 0.12) * torch.exp(-beta * distances)  # 26 °C between 20 and 70
    assert torch.allclose(part(values, splats, query()), expected, atol=1e-6)
    assert part.effects()["attenuation"]["per_unit"] == pytest.approx(beta)
    part(values, splats, query()).sum().backward()
    assert splats.means.grad is None  # haze moves no walls


def test_depth_counts_in_distances_from_a_camera_to_the_middle_of_the_points():
    """Points about the origin, cameras 3, 4 and 5 from it; an outlier moves neither median."""
    frames = [Frame(f"{z}.png", z, Camera(shifted(z), torch.eye(3), 4, 4), 10.0 * z) for z in (3, 4, 5)]
    views = ViewSet(frames, lambda i: None)
    points = torch.tensor([[-1.0, 0, 0], [0, 0, 0], [1, 0, 0], [0, 0, 0], [900, 900, 900]])
    part = Attenuation(depth=0.5, moments=0)
    part.prepare(SceneData("row", views, views, views, points, None, ThermalRange(20.0, 70.0), 26.0))
    assert part.typical.item() == pytest.approx(4.0) and part.extinction().item() == pytest.approx(0.125)


def shifted(z):
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[2, 3] = z
    return viewmat


def test_air_of_an_unknown_temperature_is_learned():
    part, other = Attenuation(), Attenuation()
    part.prepare(scene())
    other.prepare(scene(ambient_c=None))
    assert {name for name, _ in part.named_parameters()} == {"log_depth"}
    assert {name for name, _ in other.named_parameters()} == {"log_depth", "level"}


def test_extinction_over_the_record_is_cubic_in_its_logarithm_between_moments():
    part = Attenuation(depth=[math.exp(-2.0), 1.0, math.exp(-1.0)], moments=3)
    part.prepare(scene())
    typical = part.typical.item()
    for time_s, expected in (
        (-50, -2.0),
        (0, -2.0),
        (100, -0.8125),
        (200, 0.0),
        (300, -0.3125),
        (400, -1.0),
        (900, -1.0),
    ):
        assert part.extinction(time_s).item() == pytest.approx(math.exp(expected) / typical, rel=1e-5)
    with pytest.raises(ValueError, match="give time_s"):
        part.extinction(None)


def test_extinction_goes_on_through_a_gap_as_it_bends_on_both_sides():
    """Moments that no view sees: four on a parabola, whose top lies in the gap between them."""
    part = Attenuation(moments=7, smooth=1e-6)
    part.prepare(scene())
    parabola = 1 - (torch.arange(7) - 3.0).square() / 12
    seen = torch.tensor([0, 1, 5, 6])
    optimizer = torch.optim.LBFGS(part.parameters(), max_iter=200, line_search_fn="strong_wolfe")

    def closure():
        optimizer.zero_grad()
        fit = (part.log_depth.exp()[seen] - parabola[seen]).square().sum()
        loss = fit + part.regularisers(splats_of(made("static")))["extinction_smooth"]
        loss.backward()
        return loss

    optimizer.step(closure)
    top = part.log_depth.detach()[3].exp().item()
    assert top == pytest.approx(1, abs=0.05)  # a straight line through the gap would be at 0.67
    assert Attenuation(moments=2).regularisers(None) == Attenuation(moments=0).regularisers(None) == {}


@pytest.mark.parametrize(
    ("moments", "expected"), [(0, [0.3]), (2, [0.1, 0.5]), (3, [0.1, 0.3, 0.5]), (5, [0.1, 0.2, 0.3, 0.4, 0.5])]
)
def test_depths_over_the_record_are_resampled_to_the_moments_that_are_asked_for(moments, expected):
    part = Attenuation(depth=[0.1, 0.3, 0.5], moments=moments)
    torch.testing.assert_close(part.log_depth.detach().exp(), torch.tensor(expected))


def test_what_air_costs_does_not_depend_on_how_thick_it_is():
    """Or heat that is lost at all times alike would be given to the air, whose logarithm bends less then."""
    swing = [0.1, 0.3, 0.2, 0.5, 0.1]
    costs = [
        Attenuation(depth=[depth + more for depth in swing], moments=5).regularisers(None)["extinction_smooth"].item()
        for more in (0.0, 1.0)
    ]
    assert costs[0] == pytest.approx(costs[1], rel=1e-5) and costs[0] > 0


@pytest.mark.parametrize("log_depth", [-1e4, 1e4])
def test_air_is_finite_whatever_the_extinction(log_depth):
    part = Attenuation()
    part.prepare(scene())
    with torch.no_grad():
        part.log_depth.fill_(log_depth)
    seen = part(torch.rand(40, 1), splats_of(made("static")), query())
    assert seen.isfinite().all() and seen.min() >= 0 and seen.max() <= 1


def test_a_mirror_shows_what_lies_in_the_mirrored_direction():
    part = Reflection(degree=1)
    part.prepare(scene())
    with torch.no_grad():
        part.surroundings.copy_(torch.tensor([0.5, 0.0, 0.3, 0.0]) / spherical_harmonics.C0)
    splats = splats_of(made("static"))
    panes = {"reflectance_logit": torch.full((40,), 40.0), "normals": torch.tensor([[0.0, 0.0, 1.0]]).repeat(40, 1)}
    mirrors = Splats({name: splats[name] for name in splats.names} | panes)  # ρ = 1, across the z axis
    sight = spherical_harmonics.unit(mirrors.means - camera(0.3).center.float())
    mirrored = sight * torch.tensor([1.0, 1.0, -1.0])
    expected = spherical_harmonics.basis(mirrored, 1) @ part.surroundings
    assert torch.allclose(part(torch.rand(40, 1), mirrors, query())[:, 0], expected, atol=1e-6)


def test_reflection_of_even_surroundings_is_kirchhoffs_law():
    part = Reflection(degree=0, reflectance=0.25)
    part.prepare(scene())
    splats = splats_of(Composed(Static(floor=False), {"reflection": part}), disturb=0.0)
    values = torch.rand(40, 1)
    assert torch.allclose(part(values, splats, query()), 0.75 * values + 0.25 * 0.12, atol=1e-6)


def test_view_dependence_starts_at_nothing_and_grows_by_degree():
    part = ViewDependence(sh_degree=2, sh_degree_interval=10)
    model = Composed(Static(floor=False), {"view_dependence": part})
    model.prepare(scene())
    start, values = splats_of(model, disturb=0.0), torch.rand(40, 1)
    assert torch.equal(part(values, start, query()), values)
    splats = splats_of(model)
    part.on_step(9)
    assert part(values, splats, query()) is values
    part.on_step(25)
    directions = splats.means - camera(0.3).center.float()
    coefficients = torch.cat((torch.zeros(40, 1, 1), splats["view_rest"]), 1)
    expected = values + spherical_harmonics.evaluate(coefficients, directions, 2)
    assert torch.allclose(part(values, splats, query()), expected, atol=1e-5)


def test_values_beyond_the_range_may_come_back_on_their_way():
    model = Composed(Static(floor=False), {"attenuation": Attenuation(depth=1.0)})
    model.prepare(scene())
    start = seeds()
    hot = splats_of(model, Seeds(start.means, start.values + 0.8, start.generator), disturb=0.0)
    seen = model.features(hot, query())
    assert (start.values + 0.8 > 1).any() and seen.max() < 1


@pytest.mark.parametrize("state", [lambda: NewtonHarmonic(frequencies=2), Static])
def test_a_companion_has_an_opacity_of_its_own(state):
    color = Static(channels=3, modality="rgb", sh_degree=1, prefix="companion_")
    model = Composed(state(), companion=color)
    model.prepare(scene())
    splats = splats_of(model, seeds(channels=4))
    assert model.opacity_channels == (1, 3) and splats.opacities.shape == (2, 40)
    assert model.features(splats, query()).shape == (40, 4)
    assert model.effects()["thermal_opacity"] == {"opacities": 2}
    assert "thermal_opacity" not in made().effects() and made().opacity_channels == (1,)


def test_a_state_and_a_companion_of_one_kind_keep_their_tensors_apart():
    model = Composed(Static(), companion=Static(channels=3, modality="rgb", prefix="companion_"))
    model.prepare(scene())
    splats = splats_of(model, seeds(channels=4))
    features = model.features(splats, query())
    assert features.shape == (40, 4)
    assert splats["sh0"].shape == (40, 1, 1) and splats["companion_sh0"].shape == (40, 1, 3)
    torch.testing.assert_close(features[:, :1], model.state.features(splats, query()))


def test_parameters_learn_at_the_rates_of_their_owners():
    model = Composed(
        Conducting(NewtonHarmonic(ambient="learned", lr_ambient=0.7)), {"attenuation": Attenuation(lr=0.3)}
    )
    model.prepare(scene())
    rates = {name: model.rate_of(name).lr for name, _ in model.named_parameters()}
    assert rates == {"state.log_flow": 0.01, "state.state.ambient": 0.7, "parts.attenuation.log_depth": 0.3}


def test_needs_are_those_of_all_owners():
    timeless = scene(timed=False)
    with pytest.raises(SceneError, match="NewtonHarmonic needs time"):
        made("relaxation", ["attenuation"]).check(timeless)
    model = Composed(Static(floor=False), {"attenuation": Attenuation(moments=5)})
    model.check(timeless)
    model.prepare(timeless)
    part = model.parts["attenuation"]
    assert part.log_depth.shape == (1,) and part.regularisers(None) == {}
    assert part.extinction().item() == pytest.approx(0.1 / part.typical.item())


@pytest.mark.parametrize(
    "build, message",
    [
        (lambda: Composed(Static(), clip="soft"), "clip must be one of"),
        (lambda: Composed(Static(channels=3)), "the state must explain one channel"),
        (lambda: ViewDependence(sh_degree=0), "view dependence of degree 0 is none"),
        (lambda: Reflection(degree=3), "degree must be 0 to 2"),
        (lambda: Attenuation(depth=0), "depth must be positive and moments 0 or at least 2"),
        (lambda: Attenuation(moments=1), "depth must be positive and moments 0 or at least 2"),
        (lambda: Attenuation(depth=[0.1, 0.0], moments=3), "depth must be positive"),
        (lambda: Conducting(Static(), neighbours=0), "neighbours and every must be at least 1"),
    ],
)
def test_options_out_of_range_are_refused(build, message):
    with pytest.raises(ValueError, match=message):
        build()


# Conduction ---------------------------------------------------------------------------------------------


def conducting(flow=2.0):
    model = Conducting(NewtonHarmonic(frequencies=2, clip="none"), neighbours=4, flow=flow)
    model.prepare(scene())
    return model, splats_of(model)


def test_conduction_solves_its_implicit_step():
    model, splats = conducting()
    alone = model.state.features(splats, query())
    got = model.features(splats, query())
    matrix = laplacian(model.edges, 40).to_dense().double()
    assert torch.equal(matrix, matrix.T) and matrix.sum(1).abs().max() < 1e-6
    system = torch.eye(40, dtype=torch.float64) + 2.0 * (150 / SPAN_S) * matrix
    assert torch.allclose(got.double(), torch.linalg.solve(system, alone.double()), atol=1e-5)
    assert got.mean().item() == pytest.approx(alone.mean().item(), abs=1e-6)  # no heat is lost
    assert got.std() < alone.std() and got.min() >= alone.min() - 1e-6 and got.max() <= alone.max() + 1e-6


def test_a_graph_that_was_drawn_without_gradients_conducts_them():
    model, splats = conducting()
    with torch.inference_mode():  # as a test renders
        shown = model.features(splats, Query(time_s=150.0))
    again = model.features(splats, Query(time_s=150.0))
    again.sum().backward()
    assert torch.equal(again, shown) and float(splats["initial_state"].grad.abs().min()) > 0


def test_gradients_of_conduction_are_those_of_the_dense_system():
    model, splats = conducting()
    weights = torch.randn(40, 1, generator=torch.Generator().manual_seed(4))
    (model.features(splats, query()) * weights).sum().backward()
    flow = model.log_flow.detach().double().requires_grad_()
    twin = Splats({name: splats[name] for name in splats.names})
    alone = model.state.features(twin, query())
    system = torch.eye(40, dtype=torch.float64) + flow.exp() * (150 / SPAN_S) * laplacian(model.edges, 40).to_dense()
    (torch.linalg.solve(system, alone.double()) * weights).sum().backward()
    assert model.log_flow.grad.item() == pytest.approx(flow.grad.item(), rel=1e-3)
    for name in ("initial_state", "log_rate", "source_gains"):
        assert torch.allclose(splats[name].grad, twin[name].grad, rtol=1e-3, atol=1e-5)


def grid(side):
    """Laplacian of the graph that joins the nodes of a square grid with the next ones, and their places [n, 2] in [0, 1]."""
    nodes = torch.arange(side * side).view(side, side)
    pairs = [torch.stack([nodes[:, :-1], nodes[:, 1:]]), torch.stack([nodes[:-1], nodes[1:]])]
    places = torch.stack([nodes // side, nodes % side], dim=-1).flatten(0, 1) / (side - 1)
    return laplacian(torch.cat([pair.flatten(1) for pair in pairs], dim=1), side * side), places


@pytest.mark.parametrize("amount", [33.0, 330.0, 3300.0, 33000.0])
def test_much_flow_is_solved_as_closely_as_little(amount):
    """Far beyond the record: heat crosses the whole plane, which takes hundreds of steps."""
    matrix, places = grid(40)
    values, weights = (places[:, :1] > 0.37).float(), places[:, 1:] * places[:, :1]
    system = torch.eye(len(places), dtype=torch.float64) + amount * matrix.to_dense().double()
    expected, by_values = (torch.linalg.solve(system, columns.double()) for columns in (values, weights))
    by_amount = -(by_values * (matrix.to_dense().double() @ expected)).sum()
    given = values.requires_grad_(), torch.tensor(amount, requires_grad=True)
    found = _ImplicitStep.apply(*given, matrix)
    assert (found - expected).abs().max() < 5e-6
    gradients = torch.autograd.grad((found * weights).sum(), given)
    assert (gradients[0] - by_values).abs().max() < 5e-6
    assert gradients[1].item() == pytest.approx(by_amount.item(), rel=1e-3)


def test_flow_that_is_not_solved_is_told_once(monkeypatch, caplog):
    matrix, places = grid(40)
    values = (places[:, :1] > 0.37).float()
    conduction._warn_of_error.cache_clear()
    _ImplicitStep.apply(values, torch.tensor(3300.0), matrix)
    assert not caplog.messages
    monkeypatch.setattr(conduction, "SOLVER_STEPS", 1)
    for _ in range(2):
        _ImplicitStep.apply(values, torch.tensor(3300.0), matrix)
    assert len(caplog.messages) == 1 and "was not solved to 1e-06" in caplog.messages[0]
    conduction._warn_of_error.cache_clear()


def test_nothing_has_flowed_at_the_start_and_hardly_anything_differs_after_very_much():
    model, splats = conducting()
    assert torch.equal(model.features(splats, query(0.0)), model.state.features(splats, query(0.0)))
    with torch.no_grad():
        model.log_flow.fill_(1e4)
    values = model.features(splats, query())
    assert values.isfinite().all() and values.std() < 0.2 * model.state.features(splats, query()).std()


def test_flow_counts_in_spans_of_the_record_from_its_start():
    model, splats = conducting()
    values = model.state.features(splats, query())
    assert torch.equal(model.conducted(values, splats, -50.0), values)  # nothing flows back
    flowed = model.conducted(values, splats, 150.0)
    late = ViewSet([replace(frame, time_s=frame.time_s + 1000.0) for frame in scene().train.frames], lambda i: None)
    model.prepare(replace(scene(), train=late))
    assert not torch.equal(flowed, values) and torch.allclose(model.conducted(values, splats, 1150.0), flowed)


def test_the_graph_is_drawn_anew_when_gaussians_change_and_at_stated_steps():
    model, splats = conducting()
    model.every = 10
    model.features(splats, query())
    first = model.edges
    model.features(splats, query())
    assert model.edges is first
    with torch.no_grad():
        splats.raw["means"].copy_(splats.means.flip(0) ** 3)
    model.on_step(9)
    model.features(splats, query())
    assert model.edges is first
    model.on_step(10)
    model.features(splats, query())
    assert not torch.equal(model.edges, first)
    fewer = Splats({name: splats[name][:30] for name in splats.names})
    assert model.features(fewer, query()).shape == (30, 1) and model.edges.max() < 30


def test_heat_flows_between_neighbours_where_as_many_gaussians_came_as_went():
    model, splats = conducting()
    model.features(splats, query())
    cloud = Cloud(splats)
    rows = cloud.rows(torch.tensor([39]))
    cloud.keep(torch.arange(40) > 0)
    cloud.append(rows)
    model.on_rows_changed()
    fresh, _ = conducting()
    assert torch.equal(model.features(splats, query()), fresh.features(splats, query()))
