"""4DGS: planes against six plain grid samples in double precision, heads, stages, one evaluation a view, regularisers."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.nn.functional import grid_sample, leaky_relu

from heatsplat.contracts import Camera, Frame, SceneData, SceneError, ThermalRange, ViewSet
from heatsplat.physics.units import KELVIN_AT_0_C
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.hexplane import HEADS, Deformed, HexPlane
from heatsplat.thermal.static import Static

CAMERA = Camera(torch.eye(4), torch.eye(3), 8, 8)
ALL = tuple(HEADS)


def make_scene(times=tuple(range(10, 22)), points=None):
    views = ViewSet([Frame(f"{i}.png", i, CAMERA, t) for i, t in enumerate(times)], lambda index: None)
    if points is None:
        points = torch.rand(400, 3, generator=torch.Generator().manual_seed(5)) * torch.tensor([4.0, 2.0, 1.0])
    return SceneData("yard", views, views, views, points, thermal_range=ThermalRange(10.0, 30.0))


def make(count=25, disturb=0.0, scene=None, **options):
    """A model on a scene with its splats; ``disturb`` gives planes of time and last layers random values of that size."""
    model = HexPlane(Static(floor=False), **{"resolution": 6, "channels": 3, "width": 8} | options)
    model.prepare(scene or make_scene())
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) * torch.tensor([4.4, 2.2, 1.1]) - 0.05  # some beyond the box
    declared = model.per_gaussian(Seeds(means, torch.rand(count, 1, generator=generator), generator))
    geometry = {"means": means, "log_scales": torch.randn(count, 3, generator=generator) - 2}
    geometry |= {"quats": torch.randn(count, 4, generator=generator)}
    tensors = {name: item.initial for name, item in declared.items()} | geometry
    if disturb:
        with torch.no_grad():
            for tensor in (*model.time, *(head[-1].weight for head in model.heads.values())):
                tensor.add_(disturb * torch.randn(tensor.shape, generator=generator))
    return model, Splats(tensors | {"opacity_logits": torch.randn(count, 1, generator=generator)})


def query(time_s=13.7, ids=None, geometry=None):
    return Query(ids=ids, camera=CAMERA, time_s=time_s, frame_id=0, geometry=geometry)


def by_hand(model, means, time_s):
    """φ(f) in double precision: six samples of planes over (x, y) .. (z, t) by torch, one Gaussian coordinate pair each."""
    places = (means.double() - model.center.double()) / model.reach.double()
    t = torch.full((len(means), 1), 2 * (time_s - 10.0) / 11.0 - 1.0, dtype=torch.float64)
    found = []
    for space, time in zip(model.space, model.time, strict=True):
        product = 1.0
        for i, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
            for plane, grid in (
                (space[i], torch.stack((places[:, a], places[:, b]), 1)),
                (time[i], torch.cat((places[:, i : i + 1], t), 1)),
            ):
                options = {"align_corners": True, "padding_mode": "border"}
                product = product * grid_sample(plane[None].double(), grid[None, None], **options)[0, :, 0]
        found.append(product)
    return torch.cat(found).T @ model.trunk.weight.double().T + model.trunk.bias.double()


def test_the_field_is_six_grid_samples_in_double_precision():
    model, splats = make(disturb=0.5)
    assert model.time[0].shape == (3, 3, 6, 6) and model.time[1].shape == (3, 3, 6, 12)  # half of 12 frames
    for time_s in (10.0, 13.7, 21.0):
        expected = by_hand(model, splats.means.detach(), time_s)
        assert expected.std() > 0.01
        assert torch.allclose(model.hidden(splats.means, time_s).double(), expected, atol=2e-6)
    early, first = (model.hidden(splats.means, t) for t in (-1e9, 10.0))
    assert torch.equal(early, first)  # the border goes on


def test_a_gaussian_at_no_place_reads_no_memory():
    model, splats = make(disturb=0.5)
    means = splats.means.detach().clone()
    expected = model.hidden(means, 13.7)
    means[3, 1] = float("nan")
    means[4, 0] = float("inf")
    found = model.hidden(means, 13.7)
    assert torch.equal(found[:3], expected[:3]) and torch.equal(found[5:], expected[5:])


def test_gradients_agree_with_differences():
    model, splats = make(4, disturb=0.5, heads=ALL)
    model, means = model.double(), splats.means.detach().double()
    with torch.no_grad():
        means.clamp_(0.3, 0.9)

    def answer(means, space, line):
        return torch.func.functional_call(model, {"space.0": space, "time.0": line}, (means, 13.7))

    model.forward = model.hidden
    inputs = (means.requires_grad_(), model.space[0].detach().clone().requires_grad_())
    inputs = (*inputs, model.time[0].detach().clone().requires_grad_())
    assert torch.autograd.gradcheck(answer, inputs, eps=1e-6, atol=1e-7, fast_mode=True)


@pytest.mark.parametrize("heads", [("radiance",), ("radiance", "opacity"), ("means", "scales", "rotations"), ALL])
def test_it_is_exactly_3dgs_at_first(heads):
    model, splats = make(heads=heads)
    with torch.no_grad():
        splats["sh0"][:3] = -3.0
    moved = model.geometry(splats, query())
    assert (moved is None) == (heads == ("radiance",))
    if moved is not None:
        for name in ("means", "quats", "scales", "opacities"):
            assert torch.equal(getattr(moved, name), getattr(splats, name)), name
    emitted = model.features(splats, query(geometry=moved))
    assert torch.equal(emitted, Static().features(splats, query()))


def test_heads_change_the_raw_tensors_and_the_radiance():
    model, splats = make(disturb=0.4, heads=ALL)
    hidden = by_hand(model, splats.means.detach(), 13.7)
    change = {}
    for name, head in model.heads.items():
        inner = leaky_relu(leaky_relu(hidden, 0.01) @ head[1].weight.double().T + head[1].bias.double(), 0.01)
        raw = inner @ head[3].weight.double().T + head[3].bias.double()
        change[name] = HEADS[name][1] * torch.tanh(raw / HEADS[name][1])
        assert raw.abs().max() > 0.01
    moved = model.geometry(splats, query())
    expected = {
        "means": splats.means + change["means"] * torch.tensor([2.4, 1.2, 0.6]) * 0.98,
        "quats": splats.quats + change["rotations"],
        "scales": torch.exp(splats["log_scales"] + change["scales"]),
        "opacities": torch.sigmoid(splats["opacity_logits"] + change["opacity"]).T,
    }
    for name, values in expected.items():
        tolerance = 2e-2 if name == "means" else 1e-5  # quantiles of drawn points are 0.98 of the edges but for chance
        assert torch.allclose(getattr(moved, name).double(), values.double(), atol=tolerance), name
    level = Static(floor=False).features(splats, query())
    emitted = model.features(splats, query())
    assert torch.allclose(emitted.double(), (level + change["radiance"]).clamp(min=0), atol=1e-5)
    kelvins = KELVIN_AT_0_C + 10 + 20 * (level + change["radiance"])[:, 0]
    assert torch.allclose(model.temperature(splats, 13.7).double(), kelvins, atol=1e-3)


def test_the_box_is_that_of_the_bulk_and_a_fifth_more():
    points = make_scene().points
    low, high = (np.quantile(points.numpy(), q, axis=0) for q in (0.01, 0.99))
    model, _ = make()
    assert np.allclose(model.reach.numpy(), 0.6 * (high - low), rtol=1e-5)
    assert np.allclose(model.center.numpy(), 0.5 * (high + low), rtol=1e-5)
    flat = make_scene(points=points * torch.tensor([1.0, 1.0, 0.0]))
    assert (make(scene=flat)[0].reach > 0).all()


def test_the_field_is_evaluated_once_a_view_and_radiance_for_gaussians_in_view():
    model, splats = make(disturb=0.3)
    rows = {"trunk": [], "radiance": []}
    model.trunk.register_forward_hook(lambda module, inputs, output: rows["trunk"].append(len(output)))
    model.heads["radiance"].register_forward_hook(lambda module, inputs, output: rows["radiance"].append(len(output)))
    ids = torch.tensor([4, 17, 3])
    moved = model.geometry(splats, query())
    assert isinstance(moved, Deformed)
    some = model.features(splats, query(ids=ids, geometry=moved))
    assert rows == {"trunk": [25], "radiance": [3]}
    apart = model.features(splats, query(ids=ids))
    assert rows == {"trunk": [25, 3], "radiance": [3, 3]} and torch.allclose(some, apart, atol=1e-6)


def test_the_first_stage_evaluates_nothing():
    model, splats = make(disturb=0.3, first_steps=5)
    calls = []
    model.trunk.register_forward_hook(lambda *_: calls.append(1))
    model.on_step(4)
    assert model.geometry(splats, query()) is None and model.regularisers(splats) == {}
    model.features(splats, query()).sum().backward()
    assert not calls and all(parameter.grad is None for parameter in model.parameters())
    model.on_step(5)
    assert model.geometry(splats, query()) is not None and len(model.regularisers(splats)) == 3 and calls


def test_heads_that_are_off_have_no_parameter():
    names = {name.split(".")[1] for name, _ in make()[0].named_parameters() if name.startswith("heads.")}
    assert names == {"radiance", "opacity"}
    bare, _ = make(heads=["radiance"])
    assert bare.cost < make(heads=ALL)[0].cost


def test_regularisers_are_the_sums_over_planes():
    model, splats = make(disturb=0.5)
    terms = model.regularisers(splats)
    expected = {"smooth_space": 0.0, "smooth_time": 0.0, "sparse_time": 0.0}
    for scale in range(2):
        for i in range(3):
            space, time = (planes[scale][i].detach().double().numpy() for planes in (model.space, model.time))
            expected["smooth_space"] += 1e-4 * np.mean(np.diff(space, 2, axis=1) ** 2)
            expected["smooth_time"] += 1e-2 * np.mean(np.diff(time, 2, axis=1) ** 2)
            expected["sparse_time"] += 1e-4 * np.mean(np.abs(1 - time))
    assert {name: term.item() for name, term in terms.items()} == {
        f"planes/{name}": pytest.approx(value, rel=1e-5) for name, value in expected.items()
    }
    sum(terms.values()).backward()
    assert all(plane.grad.abs().max() > 0 for plane in (*model.space, *model.time))
    assert set(make(smooth_space=0.0, sparse_time=0.0)[0].regularisers(splats)) == {"planes/smooth_time"}
    short, splats = make(time_resolution=2)  # no second difference
    assert short.regularisers(splats)["planes/smooth_time"].item() == 0


@settings(max_examples=25, deadline=None)
@given(st.floats(-1e12, 1e12), st.sampled_from([0.0, 1.0, 1e4]), st.sampled_from([0.0, 1.0, 1e12]))
def test_everything_is_finite_whatever_the_place_time_and_weights(time_s, weight, spread):
    model, splats = make(8, disturb=weight, heads=ALL)
    with torch.no_grad():
        splats.means.mul_(spread)
    moved = model.geometry(splats, query(time_s))
    emitted = model.features(splats, query(time_s, geometry=moved))
    shown = (moved.means, moved.quats, moved.scales, moved.opacities, emitted)
    sum(tensor.mean() for tensor in shown).backward()
    assert all(tensor.isfinite().all() for tensor in shown) and (moved.scales > 0).all() and (emitted >= 0).all()
    found = [splats.means.grad, *(parameter.grad for parameter in model.parameters())]
    assert all(grad.isfinite().all() for grad in found if grad is not None)


def test_radiance_learns_what_warms_here_and_cools_there():
    model, splats = make(40, heads=["radiance"], time_resolution=4, width=16, channels=8)
    side = (splats.means[:, 0].detach() > 2.0).float() * 2 - 1
    times = (10.0, 15.5, 21.0)
    with torch.no_grad():
        splats["sh0"].zero_()
    optimiser = torch.optim.Adam([*model.parameters(), splats["sh0"]], lr=1e-2)
    losses = []
    for i in range(240):  # a view at a time, as in training
        time_s = times[i % 3]
        optimiser.zero_grad()
        found = model.features(splats, query(time_s))[:, 0]
        losses.append((found - 0.5 - 0.2 * side * (time_s - 15.5) / 5.5).abs().mean())
        losses[-1].backward()
        optimiser.step()
    assert sum(loss.item() for loss in losses[-3:]) / 3 < 0.03  # values that stay miss by 0.13


def test_units_that_no_gaussian_drives_learn_again_unless_the_leak_is_none():
    def gradient(leak):
        model, splats = make(disturb=0.3, heads=["radiance"], leak=leak)
        with torch.no_grad():
            model.heads["radiance"][1].bias.fill_(-10.0)
        model.features(splats, query()).sum().backward()
        return model.time[0].grad.abs().max()

    assert gradient(0.01) > 0 and gradient(0.0) == 0


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"heads must name some of means, .* got \['colour'\]"):
        HexPlane(Static(), heads=["colour"])
    with pytest.raises(ValueError, match=r"got \[\]"):
        HexPlane(Static(), heads=[])
    for name, nodes in (("resolution", 1), ("time_resolution", 0)):
        with pytest.raises(ValueError, match=f"resolutions must be at least 2, .* got .*{nodes}"):
            HexPlane(Static(), **{name: nodes})
    for name in ("first_steps", "smooth_space", "smooth_time", "sparse_time"):
        with pytest.raises(ValueError, match=f"{name}.* must not be negative, got .*-1"):
            HexPlane(Static(), **{name: -1})
    with pytest.raises(SceneError, match="HexPlane needs time, which scene 'yard'"):
        HexPlane(Static()).check(make_scene((None, None)))
    model, splats = make()
    with pytest.raises(ValueError, match="give time_s"):
        model.geometry(splats, query(None))
