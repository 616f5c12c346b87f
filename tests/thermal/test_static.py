"""The static model: seeds, directions, the degree schedule, temperature and what is absent at degree 0."""

from dataclasses import replace

import numba
import pytest
import torch

from heatsplat.contracts import Camera, SceneData, ThermalRange, ViewSet
from heatsplat.geometry import spherical_harmonics
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, Seeds
from heatsplat.thermal.static import Static


def camera_at(position):
    viewmat = torch.eye(4, dtype=torch.float64)
    viewmat[:3, 3] = -torch.as_tensor(position, dtype=torch.float64)
    return Camera(viewmat, torch.eye(3, dtype=torch.float64), 8, 8)


def scene(thermal_range=None):
    empty = ViewSet([], lambda index: None)
    return SceneData("room", empty, empty, empty, torch.zeros(4, 3), thermal_range=thermal_range)


def seeds(count=50, channels=1):
    generator = torch.Generator().manual_seed(0)
    means, values = torch.randn(count, 3, generator=generator), torch.rand(count, channels, generator=generator)
    return Seeds(means, values, generator)


def splats_of(model, seeds, rest=0.0, dtype=torch.float32):
    count = len(seeds.means)
    tensors = {name: part.initial for name, part in model.per_gaussian(seeds).items()}
    if "sh_rest" in tensors:
        tensors["sh_rest"] = rest * torch.randn(tensors["sh_rest"].shape, generator=torch.Generator().manual_seed(1))
    tensors |= {
        "means": seeds.means,
        "log_scales": torch.zeros(count, 3),
        "quats": torch.ones(count, 4),
        "opacity_logits": torch.zeros(count, 1),
    }
    return Splats({name: tensor.to(dtype) for name, tensor in tensors.items()})


@pytest.mark.parametrize("degree", [0, 2])
@pytest.mark.parametrize("channels", [1, 3])
def test_emission_starts_at_the_seed_values(degree, channels):
    model, start = Static(degree, channels, modality="rgb"), seeds(channels=channels)
    emitted = model.features(splats_of(model, start), Query(camera=camera_at([0, 0, -3.0])))
    assert torch.allclose(emitted, start.values, atol=1e-6)


def test_degree_zero_has_neither_directions_nor_further_bands():
    model = Static()
    assert list(model.per_gaussian(seeds())) == ["sh0"]
    splats = splats_of(model, seeds())
    emitted = model.features(splats, Query(ids=torch.tensor([3, 1])))  # no camera to ask
    emitted.sum().backward()
    assert emitted.shape == (2, 1)
    assert splats.means.grad is None
    assert model.effects() == {}


def test_learning_rates_are_those_of_3dgs():
    parts = Static(sh_degree=3).per_gaussian(seeds())
    assert (parts["sh0"].lr, parts["sh_rest"].lr) == (2.5e-3, 2.5e-3 / 20)
    assert parts["sh_rest"].initial.shape == (50, 15, 1)


@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("some", [False, True])
def test_float32_emission_and_gradients_agree_with_float64(degree, channels, some):
    """float32 takes the fused kernel, float64 plain torch."""
    model, start = Static(degree, channels, modality="rgb"), seeds(200, channels)
    query = Query(ids=torch.arange(0, 200, 3) if some else None, camera=camera_at([0.3, 0.1, -2.0]))
    results = []
    for dtype in (torch.float32, torch.float64):
        splats = splats_of(model, start, rest=0.3, dtype=dtype)
        emitted = model.features(splats, query)
        weights = torch.randn(emitted.shape, generator=torch.Generator().manual_seed(2)).to(dtype)
        (emitted * weights).sum().backward()
        names = ["sh0", "sh_rest", "means"] if degree > 0 else ["sh0"]
        results.append([emitted.detach()] + [splats[name].grad for name in names])
    assert (results[1][0] == 0).any() or degree == 0  # the clamp is met
    for got, expected in zip(*results, strict=True):
        assert torch.allclose(got.double(), expected, atol=1e-6 * max(1.0, expected.abs().max().item()))


@pytest.mark.parametrize("some", [False, True])
def test_the_gradient_of_the_camera_agrees_with_float64(some):
    model, start = Static(sh_degree=3), seeds(200)
    ids, found = torch.arange(0, 200, 3) if some else None, []
    for dtype in (torch.float32, torch.float64):
        camera = camera_at([0.3, 0.1, -2.0])
        viewmat = camera.viewmat.clone().requires_grad_()
        emitted = model.features(
            splats_of(model, start, rest=0.3, dtype=dtype), Query(ids, replace(camera, viewmat=viewmat))
        )
        weights = torch.randn(emitted.shape, generator=torch.Generator().manual_seed(2)).to(dtype)
        (emitted * weights).sum().backward()
        found.append(viewmat.grad)
    assert found[1].norm() > 1 and (found[0] - found[1]).norm() < 1e-5 * found[1].norm()


def test_the_number_of_threads_changes_no_bit():
    model, start = Static(sh_degree=3), seeds(1100)
    query = Query(ids=torch.arange(1, 1100, 2), camera=camera_at([0.3, 0.1, -2.0]))
    before, results = numba.get_num_threads(), []
    try:
        for threads in {1, min(2, numba.config.NUMBA_NUM_THREADS)}:
            numba.set_num_threads(threads)
            splats = splats_of(model, start, rest=0.3)
            emitted = model.features(splats, query)
            emitted.square().sum().backward()
            results.append([emitted] + [splats[name].grad for name in ("sh0", "sh_rest", "means")])
    finally:
        numba.set_num_threads(before)
    assert all(torch.equal(one, two) for one, two in zip(results[0], results[-1], strict=True))


def test_emission_depends_on_the_direction_from_the_camera():
    model, start = Static(sh_degree=1), seeds(2)
    splats = splats_of(model, start)
    with torch.no_grad():
        splats.raw["means"].zero_()
        splats.raw["sh0"].zero_()
        splats.raw["sh_rest"][:, 1] = 0.5  # the band of z
    ahead = model.features(splats, Query(camera=camera_at([0, 0, -2.0])))
    behind = model.features(splats, Query(camera=camera_at([0, 0, 2.0])))
    change = 0.5 * 0.4886025119029199
    assert torch.allclose(ahead, torch.full((2, 1), 0.5 + change))
    assert torch.allclose(behind, torch.full((2, 1), 0.5 - change))


def test_a_gaussian_at_the_camera_is_finite():
    model, start = Static(sh_degree=3), seeds(3)
    splats = splats_of(model, start, rest=0.3)
    query = Query(camera=camera_at(splats.means[1].tolist()))
    emitted = model.features(splats, query)
    emitted.sum().backward()
    assert emitted.isfinite().all()
    assert emitted[1, 0].item() == pytest.approx(start.values[1, 0].item(), abs=1e-5)
    assert all(splats[name].grad.isfinite().all() for name in ("means", "sh0", "sh_rest"))
    assert splats.means.grad[1].abs().max() == 0


def test_emission_below_zero_is_clamped_without_a_gradient():
    model = Static()
    splats = splats_of(model, seeds(2))
    with torch.no_grad():
        splats.raw["sh0"][0] = -10.0
    emitted = model.features(splats, Query())
    emitted.sum().backward()
    assert emitted[0, 0] == 0
    assert splats["sh0"].grad[0] == 0 and splats["sh0"].grad[1] == pytest.approx(spherical_harmonics.C0)


def test_degrees_join_one_by_one():
    model = Static(sh_degree=2, sh_degree_interval=10)
    degrees = []
    for step in (0, 9, 10, 19, 20, 1000):
        model.on_step(step)
        degrees.append(model.active_degree)
    assert degrees == [0, 0, 1, 1, 2, 2]
    splats = splats_of(model, seeds(), rest=0.3)
    model.on_step(10)
    model.features(splats, Query(camera=camera_at([0, 0, -3.0]))).sum().backward()
    gradient = splats["sh_rest"].grad
    assert gradient[:, :3].abs().max() > 0 and gradient[:, 3:].abs().max() == 0


def test_all_degrees_are_active_without_training_and_without_a_schedule():
    assert Static(sh_degree=3).active_degree == 3
    model = Static(sh_degree=3, sh_degree_interval=0)
    model.on_step(0)
    assert model.active_degree == 3


def test_temperature_is_that_of_the_constant_part_in_kelvin():
    model, start = Static(sh_degree=1), seeds(4)
    splats = splats_of(model, start, rest=0.3)
    model.prepare(scene())
    assert model.temperature(splats, 0.0) is None
    model.prepare(scene(ThermalRange(20.0, 70.0)))
    expected = 273.15 + 20.0 + 50.0 * start.values[:, 0]
    assert torch.allclose(model.temperature(splats, 0.0), expected)


def test_colours_have_no_temperature():
    model = Static(channels=3, modality="rgb")
    model.prepare(scene(ThermalRange(20.0, 70.0)))
    assert model.temperature(splats_of(model, seeds(channels=3)), 0.0) is None


def test_the_range_survives_a_checkpoint():
    model, other = Static(), Static()
    model.prepare(scene(ThermalRange(20.0, 70.0)))
    other.load_state_dict(model.state_dict())
    splats = splats_of(model, seeds())
    assert torch.equal(other.temperature(splats, 0.0), model.temperature(splats, 0.0))


def test_effects_and_cost_say_what_is_simulated():
    assert Static(sh_degree=3).effects() == {"view_dependence": {"degree": 3}}
    assert Static(sh_degree=0).cost < Static(sh_degree=1).cost < Static(sh_degree=3).cost


def test_errors():
    with pytest.raises(ValueError, match="degree 0 to 3 here, got 5"):
        Static(sh_degree=5)
    with pytest.raises(ValueError, match=r"channels=3 needs seed values \[50, 3\], got \[50, 1\]"):
        Static(channels=3).per_gaussian(seeds())
    model = Static(sh_degree=1)
    with pytest.raises(ValueError, match="depends on the view: give a camera"):
        model.features(splats_of(model, seeds()), Query())
    with pytest.raises(ValueError, match="modality must be one of thermal, rgb, got 'visible'"):
        Static(modality="visible")
    with pytest.raises(ValueError, match="sh_degree_interval must be a number of steps, or 0, got -1"):
        Static(sh_degree_interval=-1)


@pytest.mark.parametrize("wrong", [-1, 0, "abc", None, 1.5])
def test_channels_that_no_image_has_are_refused(wrong):
    with pytest.raises(ValueError, match=f"^channels must be a whole number, 1 or more, got {wrong}"):
        Static(channels=wrong)
    with pytest.raises(ValueError, match=f"^companions.rgb must be a whole number, 1 or more, got {wrong}"):
        Static(companions={"rgb": wrong})
