"""Sparse heat sources: which Gaussians need one, what is stored and computed for the others, and what carries it along."""

import math

import pytest
import torch
from running import TINY, run

from heatsplat.contracts import Camera, Frame, SceneData, ThermalRange, View, ViewSet
from heatsplat.density.ops import Cloud
from heatsplat.physics.fused import visible_temperature
from heatsplat.splats import Splats
from heatsplat.thermal.newton_harmonic import NewtonHarmonic
from heatsplat.thermal.sparse_sources import RATES, SparseSources, relaxation_of

COUNT, SPAN_S = 60, 400.0
OMEGA = 2 * math.pi * torch.linspace(1, 9, 24, dtype=torch.float64)
KEPT = torch.arange(COUNT) % 3 == 0
PLACES = torch.where(KEPT, KEPT.cumsum(0) - 1, -1)


def leaves(dtype=torch.float32):
    generator = torch.Generator().manual_seed(0)
    rate = torch.empty(COUNT).uniform_(0.05, 8, generator=generator)
    tensors = {
        "ambient": torch.tensor(0.3),
        "initial": torch.rand(COUNT, generator=generator),
        "rate": rate,
        "gains": torch.randn(COUNT, 2, 24, generator=generator),
        "inverse_capacity": torch.rand(COUNT, generator=generator) + 0.5,
    }
    return {name: tensor.to(dtype).requires_grad_() for name, tensor in tensors.items()}


def seen(tensors, ids=None, places=None, gains=None):
    """Values and the gradients of their weighted sum."""
    values = visible_temperature(
        torch.tensor(0.7, dtype=torch.float64),
        **(tensors if gains is None else tensors | {"gains": gains}),
        omega=OMEGA,
        ids=ids,
        places=places,
    )
    (values * torch.linspace(-1, 1, len(values))).sum().backward()
    return values.detach()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("ids", [None, torch.tensor([7, 3, 58, 30, 0])])
def test_all_sources_in_place_are_the_dense_form_bit_for_bit(dtype, ids):
    dense, sparse = leaves(dtype), leaves(dtype)
    expected, values = seen(dense, ids), seen(sparse, ids, torch.arange(COUNT))
    assert torch.equal(values, expected)
    for name, tensor in sparse.items():
        assert torch.equal(tensor.grad, dense[name].grad), name


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("ids", [None, torch.tensor([7, 3, 58, 30, 0])])
def test_sparse_sources_are_dense_ones_with_zeros(dtype, ids):
    """Values and gradients, those of the gains in their own rows; float32 is the kernel, float64 its twin."""
    dense, sparse = leaves(dtype), leaves(dtype)
    with torch.no_grad():
        dense["gains"][~KEPT] = 0
    gains = sparse["gains"].detach()[KEPT].requires_grad_()
    expected, values = seen(dense, ids), seen(sparse, ids, PLACES, gains)
    assert torch.equal(values, expected)
    torch.testing.assert_close(gains.grad, dense["gains"].grad[KEPT], rtol=0, atol=0)
    assert gains.grad.any()
    for name in ("ambient", "initial", "rate", "inverse_capacity"):
        torch.testing.assert_close(sparse[name].grad, dense[name].grad, msg=name)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_lost_its_source_only_relaxes(dtype):
    sparse, plain = leaves(dtype), leaves(dtype)
    values = seen(sparse, None, PLACES, sparse["gains"].detach()[KEPT].requires_grad_())
    none = torch.full((COUNT,), -1)
    empty = seen(sparse, None, none, torch.zeros(0, 2, 24, dtype=dtype, requires_grad=True))
    del plain["gains"], plain["inverse_capacity"]
    expected = seen(plain)
    assert torch.equal(values[~KEPT], expected[~KEPT])
    assert torch.equal(empty, expected)
    assert not torch.equal(values, expected)


def test_the_kernel_has_the_gradients_of_its_twin():
    found = {}
    for dtype in (torch.float32, torch.float64):
        tensors = leaves(dtype)
        gains = tensors["gains"].detach()[KEPT].requires_grad_()
        seen(tensors, torch.tensor([9, 1, 58, 30, 0]), PLACES, gains)
        found[dtype] = [tensors[name].grad for name in ("ambient", "initial", "rate", "inverse_capacity")] + [
            gains.grad
        ]
    for single, exact in zip(found[torch.float32], found[torch.float64], strict=True):
        torch.testing.assert_close(single.double(), exact, rtol=3e-5, atol=3e-6)


def test_wrong_places_are_refused():
    with pytest.raises(ValueError, match=r"places must be int64 of shape \[60\], got torch.int64 of \[4\]"):
        seen(leaves(), places=torch.arange(4))
    with pytest.raises(ValueError, match=r"gains must have shape \[60, 2, 24\], got \[4, 2, 24\]"):
        seen(leaves(), gains=torch.zeros(4, 2, 24))


def cloud(count=8):
    """Gaussians 1, 4 and 6 with a row of "gains", their number; Adam has made a step."""
    tensors = {"means": torch.arange(count, dtype=torch.float32)[:, None].repeat(1, 3)}
    tensors |= {"log_scales": torch.zeros(count, 3), "quats": torch.ones(count, 4)}
    tensors |= {"opacity_logits": torch.zeros(count, 1), "start": torch.zeros(count)}
    tensors["gains"] = torch.arange(1.0, count + 1)[:, None, None].repeat(1, 2, 3)
    splats = Splats(tensors)
    optimizer = torch.optim.Adam([{"params": [splats[name]], "name": name} for name in splats.names], lr=0.0)
    sum(splats[name].square().sum() for name in splats.names).backward()
    optimizer.step()
    gone = torch.ones(count, dtype=torch.bool)
    gone[[1, 4, 6]] = False
    made = Cloud(splats, optimizer)
    made.drop("gains", gone, {"start": torch.full((count,), 5.0)})
    return made


def check(made, owners):
    """``owners``: for each Gaussian the number that its gains had at first, or None."""
    gains, places = made.splats["gains"], made.splats.places("gains")
    assert [None if place < 0 else round(gains[place, 0, 0].item()) for place in places.tolist()] == owners
    assert len(gains) == sum(owner is not None for owner in owners)
    held = [group["params"][0] for group in made.optimizer.param_groups if group["name"] == "gains"]
    assert held[0] is gains
    return made.optimizer.state[gains]["exp_avg"]


def test_dropped_rows_leave_with_their_moments():
    made = cloud()
    moments = check(made, [None, 2, None, None, 5, None, 7, None])
    torch.testing.assert_close(moments, 0.2 * made.splats["gains"].detach())
    assert made.splats["start"].tolist() == [5, 0, 5, 5, 0, 5, 0, 5]
    made.drop("gains", torch.arange(8) < 4, {"start": torch.full((8,), 9.0)})
    check(made, [None, None, None, None, 5, None, 7, None])
    assert made.splats["start"].tolist() == [5, 9, 5, 5, 0, 5, 0, 5]


def test_density_control_keeps_rows_and_owners_together():
    made = cloud()
    made.keep(torch.tensor([True, True, False, True, False, True, True, True]))
    moments = check(made, [None, 2, None, None, 7, None])
    torch.testing.assert_close(moments, 0.2 * made.splats["gains"].detach())
    rows = made.rows(torch.tensor([4, 0, 1]))
    assert rows["gains"].shape == (3, 2, 3) and rows["gains"][:, 0, 0].tolist() == [7, 0, 2]
    made.append(rows)
    moments = check(made, [None, 2, None, None, 7, None, 7, None, 2])
    assert not moments[2:].any() and moments[:2].all()
    assert made.splats.means[:, 0].tolist() == [0, 1, 3, 5, 6, 7, 6, 0, 1]
    made.overwrite("gains", made.splats.dense("gains", made.splats["gains"].detach(), torch.arange(9)) + 1)
    assert not check(made, [None, 3, None, None, 8, None, 8, None, 3]).any()
    made.keep(made.splats.places("gains") < 0)
    check(made, [None] * 5)
    sum(made.splats[name].square().sum() for name in made.splats.names).backward()
    made.optimizer.step()


def test_a_checkpoint_carries_which_rows_there_are():
    made = cloud().splats
    dense = Splats({name: torch.zeros(5, *made[name].shape[1:]) for name in made.names})
    assert not [name for name in dense.state_dict() if "places" in name]
    dense.resize(8)
    dense.load_state_dict(made.state_dict())
    assert torch.equal(dense["gains"], made["gains"]) and torch.equal(dense.places("gains"), made.places("gains"))
    other = Splats({name: torch.ones(8, *made[name].shape[1:]) for name in made.names})
    dense.resize(8)
    dense.load_state_dict(other.state_dict())
    assert dense.places("gains") is None and torch.equal(dense["gains"], other["gains"])


def test_the_closest_relaxation_is_found():
    times = torch.linspace(0, 1, 64, dtype=torch.float64)
    rates, starts = torch.tensor([0.3, 2.0, 11.0], dtype=torch.float64), torch.tensor([0.5, -0.2, 0.7])
    found, rate, error = relaxation_of(starts.double() * torch.exp(-rates * times[:, None]), times)
    torch.testing.assert_close(rate, rates, rtol=0.01, atol=0)
    torch.testing.assert_close(found.float(), starts, rtol=0.01, atol=0)
    assert error.max() < 1e-3  # the noise of a camera of 0.05 K over 40 K
    assert RATES[0] < 0.011 and RATES[-1] > 99
    assert relaxation_of(torch.sin(9 * times)[:, None], times)[2] > 0.3


def scene(noise=0.002, first_s=0.0):
    generator = torch.Generator().manual_seed(3)
    camera = Camera(torch.eye(4), torch.eye(3), 40, 40)
    times = first_s + torch.linspace(0, SPAN_S, 81)
    frames = [Frame(f"{i}.png", i, camera, time) for i, time in enumerate(times.tolist())]
    ramp = torch.linspace(0.2, 0.8, 40)[:, None] * torch.ones(40)
    images = [(ramp + noise * torch.randn(40, 40, generator=generator))[..., None].float() for _ in frames]
    views = ViewSet(frames, lambda i: View(frames[i], thermal=images[i]))
    return SceneData("kettle", views, views, views, torch.zeros(4, 3), None, ThermalRange(20.0, 70.0), 26.0)


def test_the_noise_is_that_of_the_camera():
    sources = SparseSources([1])
    sources.prepare(scene(0.002), "thermal")
    assert sources.noise == pytest.approx(0.002, rel=0.1)


@pytest.mark.parametrize("first_s", [0.0, 300.0])
@pytest.mark.parametrize("param", ["rate", "faithful"])
def test_sources_go_where_relaxation_tells_the_same(param, first_s):
    """Three bodies: one driven, one whose source is nothing, one whose source makes up for a wrong rate."""
    model = NewtonHarmonic(param=param, drop_sources_at=[5], source_noise=0.002, source_floor=2.0)
    model.prepare(scene(first_s=first_s))
    initial = torch.tensor([0.5, 0.5, 0.9])
    gains = torch.zeros(3, 2, len(model.omega))
    gains[0, 0, 2] = 3.0
    tensors = {"means": torch.zeros(3, 3), "log_scales": torch.zeros(3, 3), "quats": torch.ones(3, 4)}
    tensors |= {"opacity_logits": torch.zeros(3, 1), "initial_state": initial, "source_gains": gains}
    rates = {"log_rate": torch.full((3,), 1.0)}
    if param == "faithful":
        rates = {"log_capacity": torch.full((3,), 0.5), "log_conductance": torch.full((3,), 1.5)}
    splats = Splats(tensors | rates)
    times = model.sources.times_s
    with torch.no_grad():  # a source that, together with its rate, gives the course of another rate
        wanted = model.ambient + (0.9 - model.ambient) * torch.exp(-1.7 * (torch.tensor(times) - first_s) / SPAN_S)
        unit = torch.eye(2 * len(model.omega)).reshape(-1, 2, len(model.omega))
        columns = []
        for one in unit:
            splats["source_gains"][2] = one
            columns.append(torch.stack([model._state(splats, time, torch.tensor([2]))[0] for time in times]))
        splats["source_gains"][2] = 0
        alone = torch.stack([model._state(splats, time, torch.tensor([2]))[0] for time in times])
        responses = (torch.stack(columns, 1) - alone[:, None]).double()
        fitted = torch.linalg.lstsq(responses, (wanted - alone).double()[:, None], driver="gelsd", rcond=1e-7).solution
        splats["source_gains"][2] = fitted.float().reshape(2, -1)
        before = torch.stack([model._state(splats, time, None) for time in times])
        heat = (before[:, 2] - alone).square().mean().sqrt()
        assert heat > 20 * 0.002  # its heat alone is far above the noise
    cloud = Cloud(splats)
    for step in (4, 5, 6):
        for needless in model.rows_to_drop(splats, step):
            cloud.drop(*needless)
        assert (splats.places("source_gains") is not None) == (step >= 5)
    assert splats.places("source_gains").tolist() == [0, -1, -1]
    assert splats["source_gains"].shape[0] == 1
    with torch.no_grad():
        after = torch.stack([model._state(splats, time, None) for time in times])
    assert (after - before).square().mean(0).sqrt().max() <= 2 * 0.002
    assert torch.equal(after[:, 0], before[:, 0])


def test_without_the_option_nothing_is_there():
    model = NewtonHarmonic()
    model.prepare(scene())
    model.on_step(0)
    assert model.sources is None
    assert model.state_dict().keys() == NewtonHarmonic(drop_sources_at=[1]).state_dict().keys()
    splats = cloud(8).splats
    fresh = Splats({name: torch.zeros(8, *splats[name].shape[1:]) for name in splats.names})
    assert fresh.places("gains") is None and list(dict(fresh.named_buffers())) == []


def test_unknown_noise_drops_nothing_and_says_so(caplog):
    sources = SparseSources([1])
    flat = scene(0.0)
    still = ViewSet(flat.train.frames, lambda i: View(flat.train.frames[i], thermal=torch.full((40, 40, 1), 0.5)))
    sources.prepare(SceneData("kettle", still, still, still, torch.zeros(4, 3)), "thermal")
    assert "no source is dropped; give source_noise" in caplog.text
    with pytest.raises(ValueError, match="must not be negative, got .*-1"):
        SparseSources([-1])


SHORT = (
    *TINY,
    "method=etgs",
    "data.scene=cooling",
    "test=false",
    "max_steps=12",
    "density=adaptive",
    "optim.length_power=0",
    "trainer.val_check_interval=12",
    "density.start=2",
    "density.every=5",
    "density.stop=12",
    "callbacks.checkpoint.every_n_train_steps=6",
    "thermal.drop_sources_at=[3,8]",
    "thermal.source_noise=0.001",
    "thermal.source_floor=0.02",
)


def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path):
    """Sources are dropped before and after the checkpoint, and density control works on what is left."""
    whole, trainer = run(tmp_path / "whole", *SHORT)
    resumed, again = run(tmp_path / "rest", *SHORT, f"ckpt={tmp_path / 'whole' / 'checkpoints' / 'step_000006.ckpt'}")
    assert 0 < len(whole.splats["source_gains"]) < len(whole.splats) != 600
    assert whole.state_dict().keys() == resumed.state_dict().keys()
    for name, tensor in whole.state_dict().items():
        assert torch.equal(resumed.state_dict()[name], tensor), name
    for made, expected in zip(again.optimizers[0].param_groups, trainer.optimizers[0].param_groups, strict=True):
        for key, moment in trainer.optimizers[0].state[expected["params"][0]].items():
            assert torch.equal(again.optimizers[0].state[made["params"][0]][key], moment), (made["name"], key)
    frame = whole.scene.train.frames[0]
    assert torch.equal(resumed.predict(frame), whole.predict(frame))
