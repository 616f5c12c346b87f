"""Calibration, gain control and tone: the identity at first, bounds, gauges, gradients, recovery of a known sensor."""

import math

import mpmath
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from heatsplat.contracts import Camera, Frame, SceneData, ViewSet
from heatsplat.geometry.resampling import resampled
from heatsplat.sensors.agc import EPSILON, GainControl
from heatsplat.sensors.base import SensorChain, SensorPart
from heatsplat.sensors.calibration import Calibration, radius_squared
from heatsplat.sensors.tone import Tone

HEIGHT, WIDTH = 24, 40


def make_scene(count=5, width=WIDTH, height=HEIGHT):
    frames = [Frame(f"{i}.png", 3 * i, Camera(torch.eye(4), torch.eye(3), width, height)) for i in range(count)]
    views = ViewSet(frames, lambda index: None)
    return SceneData("room", views, views, views, torch.zeros(4, 3))


SCENE = make_scene()
FRAME = SCENE.train.frames[1]
PARTS = {"calibration": Calibration, "agc": GainControl, "tone": Tone, "exact tone": lambda: Tone(exact=True)}


def ready(name, scale=0.0, seed=0):
    """A part on the scene; ``scale`` gives all its parameters random values of that size."""
    part = PARTS[name]()
    part.prepare(SCENE)
    if scale:
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for parameter in part.parameters():
                parameter.add_(scale * torch.randn(parameter.shape, generator=generator))
    return part


def noise(channels=1, low=0.0, high=1.0, seed=0, height=HEIGHT, width=WIDTH):
    return low + (high - low) * torch.rand(height, width, channels, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("name", PARTS)
@pytest.mark.parametrize("low, high", [(0.0, 1.0), (-2.0, 3.0)])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_new_part_is_exactly_the_identity(name, low, high, channels):
    image = noise(channels, low, high)
    image[0, 0], image[0, 1] = 0.0, 1.0
    assert torch.equal(ready(name)(image, FRAME), image)


@pytest.mark.parametrize("name", PARTS)
def test_a_new_part_passes_gradients_and_can_leave_the_identity(name):
    image = noise(low=0.1, high=0.9).requires_grad_()
    part = ready(name)
    weights = noise(seed=1)
    (part(image, FRAME) * weights).sum().backward()
    assert torch.allclose(image.grad, weights, atol=1e-4)
    assert any(parameter.grad.abs().max() > 1e-3 for parameter in part.parameters() if parameter.grad is not None)


@pytest.mark.parametrize("name", PARTS)
def test_without_a_weight_there_is_no_regulariser_and_with_one_it_rests_at_the_identity(name):
    part = ready(name)
    assert part.regulariser().item() == 0.0
    assert ready(name, 1.0).regulariser() > 0
    part.weight = 0.0
    assert part.regulariser() is None


@settings(max_examples=40, deadline=None)
@given(st.sampled_from(sorted(PARTS)), st.floats(0.0, 1e3), st.integers(0, 50), st.floats(-0.5, 1.5))
def test_effects_are_bounded_and_gradients_finite_whatever_the_parameters(name, scale, seed, level):
    part = ready(name, scale, seed)
    image = (level + 0.2 * noise(low=-1.0, seed=seed)).requires_grad_()
    seen = part(image, FRAME)
    seen.square().sum().backward()
    assert seen.isfinite().all() and image.grad.isfinite().all()
    assert all(p.grad is None or p.grad.isfinite().all() for p in part.parameters())
    limit = image.abs().max().item()
    if name == "calibration":
        left = torch.eye(256) - part.shared @ part.shared.T
        spread = left.abs().sum(1).max().item()  # what taking common parts away can do to a bounded grid
        bound = (limit * (1 + 0.1 * spread) + 0.05 * 2) * math.exp(2 * 0.5)
        assert spread < 4
    elif name == "agc":
        bound = limit + 1
    else:  # the best line through a correction within ±0.12 has a slope within 0.36 and a level within 0.30
        bound = (1.08 + 0.36) * limit + 0.04 + 0.30
    assert seen.abs().max() <= bound * (1 + 1e-5)


# Calibration ----------------------------------------------------------------------------------------------


def test_calibration_is_the_formula_of_the_paper():
    part, image = ready("calibration", 0.8), noise()
    gain, bias = (resampled(node[..., None], HEIGHT, WIDTH, "bilinear") for node in part.nodes().values())
    v, u = torch.meshgrid(torch.arange(HEIGHT) + 0.5, torch.arange(WIDTH) + 0.5, indexing="ij")
    r = torch.hypot(u - WIDTH / 2, v - HEIGHT / 2) / math.hypot(WIDTH / 2, HEIGHT / 2)
    a2, a4 = part.coefficients().tolist()
    falloff = torch.exp(a2 * r**2 + a4 * r**4)[..., None]
    assert torch.allclose(part(image, FRAME), (image * (1 + gain) + bias) * falloff, atol=1e-6)


def test_the_gauges_are_removed():
    part = ready("calibration", 2.0)
    gain, bias = part.nodes().values()
    assert abs(bias.mean().item()) < 1e-7
    r2 = radius_squared(16, 16, WIDTH / HEIGHT)
    for power in range(3):  # nothing of a constant, r² or r⁴ is left
        assert abs((gain * r2**power).mean().item()) < 1e-7
    alone = Calibration(vignetting_max=0.0)
    alone.prepare(SCENE)
    with torch.no_grad():
        alone.raw_gain.copy_(r2)
    assert abs(alone.nodes()["gain"].mean().item()) < 1e-7
    assert (alone.nodes()["gain"] * r2).mean().abs() > 1e-4  # without vignetting a radial gain is the gain's to say


def test_the_field_is_the_same_at_every_resolution():
    part = ready("calibration", 0.5)
    coarse = part(torch.full((80, 112, 1), 0.5), FRAME)
    fine = part(torch.full((320, 448, 1), 0.5), FRAME)
    difference = (resampled(fine, 80, 112, "area") - coarse).abs()
    assert difference.median() < 2e-5 and difference.mean() < 5e-4  # only kinks at the nodes differ by averaging
    assert coarse.diff(dim=1).abs().median() > 1e-3  # a shift by a pixel would show


def test_radius_is_zero_in_the_middle_and_one_in_the_corners():
    r2 = radius_squared(301, 401)
    assert r2[150, 200] == 0
    corners = r2[[0, 0, -1, -1], [0, -1, 0, -1]]
    assert torch.allclose(corners, torch.ones(4, dtype=torch.float64), atol=0.02) and corners.max() < 1


def test_without_vignetting_there_is_no_parameter_of_it():
    part = Calibration(vignetting_max=0.0)
    part.prepare(SCENE)
    assert {name for name, _ in part.named_parameters()} == {"raw_gain", "raw_bias"}
    assert torch.equal(part.vignetting(4, 5), torch.ones(4, 5, 1))


def test_without_bounds_the_pattern_is_absent():
    part, image = Calibration(gain_max=0.0, bias_max=0.0), noise()
    part.prepare(SCENE)
    assert {name for name, _ in part.named_parameters()} == {"raw_falloff"} and not list(part.buffers())
    assert part.nodes() == {} and set(part.effects()) == {"vignetting"}
    with torch.no_grad():
        part.raw_falloff.fill_(0.5)
    assert torch.equal(part(image, FRAME), image * part.vignetting(HEIGHT, WIDTH))
    assert part.regulariser().item() == pytest.approx(5e-4 * part.coefficients().square().sum().item())


def test_gain_and_bias_can_be_left_out_one_by_one():
    bias, gain = Calibration(gain_max=0.0, vignetting_max=0.0), Calibration(bias_max=0.0, vignetting_max=0.0)
    assert set(bias.nodes()) == {"bias"} and set(gain.nodes()) == {"gain"}
    assert set(bias.effects()) == {"fixed_pattern"}
    with torch.no_grad():
        bias.raw_bias[3, 5] = 1.0
    change = bias(noise(), FRAME) - noise()
    assert torch.allclose(bias(noise(seed=1), FRAME) - noise(seed=1), change, atol=1e-6)  # the same at every brightness
    assert Calibration(gain_max=0, bias_max=0, vignetting_max=0).regulariser() is None


def test_a_known_sensor_is_recovered_from_images_of_known_scenes():
    """Fixed pattern to a correlation of 0.9 and vignetting to 2 % in the corners, from 24 noisy images."""
    generator = torch.Generator().manual_seed(4)
    size = (32, 48)
    scene = make_scene(width=size[1], height=size[0])
    truth = Calibration()
    truth.prepare(scene)
    with torch.no_grad():
        truth.raw_gain.copy_(resampled(torch.randn(5, 5, 1, generator=generator), 16, 16, "bicubic")[..., 0])
        truth.raw_bias.copy_(resampled(torch.randn(5, 5, 1, generator=generator), 16, 16, "bicubic")[..., 0])
        truth.raw_falloff.copy_(torch.tensor([-0.5, -0.2]))
    images = resampled(torch.rand(6, 8, 24, generator=generator), *size, "bilinear")  # channels are images here
    frame = scene.train.frames[0]
    seen = truth(images, frame).detach() + 0.005 * torch.randn(*size, 24, generator=generator)
    part = Calibration()
    part.prepare(scene)
    optimizer = torch.optim.Adam(part.parameters(), lr=0.05)
    for _ in range(100):
        optimizer.zero_grad()
        loss = (part(images, frame) - seen).abs().mean() + part.regulariser()
        loss.backward()
        optimizer.step()
    for got, expected in zip(part.nodes().values(), truth.nodes().values(), strict=True):
        assert torch.corrcoef(torch.stack((got.flatten(), expected.flatten())))[0, 1] > 0.9
    corner = (part.vignetting(*size) / truth.vignetting(*size))[0, 0].item()
    assert corner == pytest.approx(1.0, abs=0.02)
    assert truth.vignetting(*size)[0, 0] < 0.8  # there was something to find


@pytest.mark.parametrize(
    "make, message",
    [
        (lambda: Calibration(grid=1), "needs 2 nodes along each side or more, got 1"),
        (lambda: Calibration(grid=2), "tell no gain from vignetting: give a grid of 3 or more"),
        (lambda: Calibration(gain_max=-0.1), "gain_max, bias_max and vignetting_max must not be negative, got -0.1"),
        (lambda: GainControl(stretch_max=1.0), "stretch_max must be above 1 and shift_max not negative, got 1.0"),
        (lambda: Tone(width=1), "width must be at least 2, gain_max and offset_max not negative, got 1"),
    ],
)
def test_options_out_of_range(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# Gain control ---------------------------------------------------------------------------------------------


def test_gain_control_is_the_formula_of_the_paper_to_fifty_digits():
    part, image = ready("agc", 1.0), noise(seed=3)
    seen = part(image, FRAME)
    log_stretch, shift = part.settings()[1].tolist()
    with mpmath.workdps(50):
        for x, y in zip(image.flatten()[::37].tolist(), seen.flatten()[::37].tolist(), strict=True):
            if EPSILON < x < 1 - EPSILON:
                logit = mpmath.log(mpmath.mpf(x) / (1 - mpmath.mpf(x)))
                expected = 1 / (1 + mpmath.exp(-(mpmath.exp(log_stretch) * logit + shift)))
                assert y == pytest.approx(float(expected), abs=3e-7)


def test_gain_control_is_monotone():
    part = ready("agc", 3.0)
    ramp = torch.linspace(0, 1, 2001)[None, :, None]
    assert (part(ramp, FRAME).diff(dim=1) > -1e-6).all()


def test_every_training_image_has_its_own_and_their_mean_is_nobodys():
    part = ready("agc", 1.0)
    assert torch.allclose(part.settings().mean(0), torch.zeros(2), atol=1e-7)
    image = noise(low=0.2, high=0.8)
    first, second = (part(image, frame) for frame in SCENE.train.frames[:2])
    assert not torch.allclose(first, second, atol=1e-3)
    with torch.no_grad():
        part.raw += 0.1 - part.raw  # the same for all
    assert torch.allclose(part(image, FRAME), image, atol=1e-6)


def test_an_image_that_was_not_trained_on_is_left_as_it_is():
    part, image = ready("agc", 1.0), noise()
    stranger = Frame("test.png", 4, FRAME.camera)
    assert part(image, stranger) is image


def test_saturated_pixels_keep_a_gradient_and_it_is_bounded():
    part = ready("agc", 1.0)
    image = torch.tensor([-0.2, 0.0, EPSILON, 0.5, 1 - EPSILON, 1.0, 1.3])[None, :, None].requires_grad_()
    part(image, FRAME).sum().backward()
    assert image.grad[0, [0, 1, 5, 6], 0].tolist() == [1.0, 1.0, 1.0, 1.0]
    assert (image.grad > 0).all() and image.grad.max() < 4 / EPSILON


# Tone -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(3))
def test_the_curve_between_levels_is_that_of_the_network(seed):
    image = noise(3, seed=seed)
    levels, exact = ready("tone", 0.3, seed), ready("exact tone", 0.3, seed)
    levels.straight = exact.straight = bool(seed % 2)
    seen, expected = levels(image, FRAME), exact(image, FRAME)
    assert (seen - expected).abs().max() < 0.25 / 255
    assert (expected - image).abs().max() > 0.001  # there is a curve


def test_tone_has_no_straight_part():
    part = ready("tone", 0.3)
    ramp = torch.linspace(0, 1, 256)[None, :, None]
    correction = (part(ramp, FRAME) - ramp).flatten().double()
    assert abs(correction.mean().item()) < 1e-6
    assert abs((correction * (ramp.flatten() - 0.5)).mean().item()) < 1e-6
    assert correction.abs().max() > 1e-3  # a bend is left
    part.straight = True
    assert abs((part(ramp, FRAME) - ramp).mean().item()) > 1e-3


def test_tone_bounds_are_reached_and_not_crossed():
    part = Tone(straight=True)
    with torch.no_grad():
        part.network[4].bias.copy_(torch.tensor([100.0, -100.0]))
    image = noise()
    assert torch.allclose(part(image, FRAME), image * 1.08 - 0.04, atol=1e-6)


def test_tone_starts_without_a_draw_from_varied_units():
    torch.manual_seed(1)
    first = Tone()
    torch.manual_seed(2)
    second = Tone()
    assert all(torch.equal(a, b) for a, b in zip(first.parameters(), second.parameters(), strict=True))
    hidden = first.network[:4](first.levels)
    assert torch.linalg.matrix_rank(hidden, rtol=1e-4) > 20  # a curve of many shapes is within reach


def test_tone_learns_a_curve():
    part, levels = Tone(straight=True), torch.linspace(0, 1, 200)[None, :, None]
    target = levels + 0.03 * torch.sin(2 * math.pi * levels)
    optimizer = torch.optim.Adam(part.parameters(), lr=2e-3)
    for _ in range(80):
        optimizer.zero_grad()
        loss = (part(levels, FRAME) - target).square().mean()
        loss.backward()
        optimizer.step()
    assert loss.sqrt() < 0.005


# The chain ------------------------------------------------------------------------------------------------


def test_a_part_that_is_none_is_absent_and_an_empty_chain_gives_back_its_image():
    chain = SensorChain({"calibration": ready("calibration"), "agc": None})
    assert list(chain.parts) == ["calibration"]
    image = noise()
    assert SensorChain({"tone": None})(image, FRAME) is image
    assert SensorChain({"tone": None}).regularisers() == {}


@pytest.mark.parametrize(
    ("returned", "told"),
    [(lambda image: image[..., 0], r"a tensor of shape \[\d+, \d+\]"), (lambda image: None, "of type NoneType")],
)
def test_a_part_that_returns_no_image_is_named(returned, told):
    class Mistaken(SensorPart):
        def forward(self, image, frame):
            return returned(image)

    with pytest.raises(ValueError, match=rf"sensor part Mistaken returned is {told}; it must be an image \[H, W, 1\]"):
        SensorChain({"mistaken": Mistaken()})(noise(), FRAME)


def test_the_whole_chain_is_the_identity_at_first_and_names_its_regularisers():
    chain = SensorChain({name: ready(name) for name in ("calibration", "agc", "tone")})
    image = noise()
    assert torch.equal(chain(image, FRAME), image)
    assert set(chain.regularisers()) == {"calibration", "agc", "tone"}
    assert all(isinstance(part, SensorPart) and 0 < part.lr_end <= 1 for part in chain.parts.values())
