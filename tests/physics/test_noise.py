"""The noise of a sensor, judged from images."""

import math

import pytest
import torch

from heatsplat.contracts import Camera, Frame, View, ViewSet
from heatsplat.physics.noise import MIN_NOISE, noise_of, noise_of_repeats, noise_of_views, quantum_of, robust_spread


def scene_images(frames: int, noise: float, seed: int = 0) -> torch.Tensor:
    """Smooth images with a few steps, and noise of a standard deviation."""
    y, x = torch.meshgrid(torch.linspace(0, 1, 60), torch.linspace(0, 1, 80), indexing="ij")
    clean = 0.4 + 0.2 * torch.sin(5 * x + 3 * y) + 0.3 * (x > 0.6) - 0.2 * (y > 0.7)
    return clean + noise * torch.randn(frames, 60, 80, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize("noise", [0.002, 0.01, 0.05])
def test_noise_is_found_beside_edges(noise):
    assert noise_of(scene_images(6, noise).double()) == pytest.approx(noise, rel=0.15)


@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_noise_of_repeats_does_not_count_a_drift(noise):
    drift = torch.linspace(0, 0.5, 20)[:, None, None] ** 2
    assert noise_of_repeats(scene_images(20, noise) + drift) == pytest.approx(noise, rel=0.05)


def test_noise_is_never_below_that_of_rounding():
    grey = (scene_images(4, 0.0) * 255).round() / 255
    step = quantum_of(grey[0])
    assert step == pytest.approx(1 / 255, rel=1e-3)
    assert noise_of(grey.double(), step) >= step / math.sqrt(12)


def test_noise_of_views_of_several_sizes_leaves_masked_pixels_out():
    camera = Camera(torch.eye(4), torch.eye(3), 80, 60)
    frames = [Frame(str(i), i, camera) for i in range(7)]

    def view(i: int) -> View:
        image = scene_images(1, 0.01, seed=i)[0, : 60 - 2 * i]
        mask = torch.ones_like(image, dtype=torch.bool)
        mask[:, 40:] = False
        image[:, 40:] += torch.randn(image[:, 40:].shape, generator=torch.Generator().manual_seed(i))
        return View(frames[i], image[..., None], mask=mask)

    assert noise_of_views(ViewSet(frames, view), "thermal") == pytest.approx(0.01, rel=0.15)


def test_views_that_are_masked_whole_do_not_lower_the_noise():
    camera = Camera(torch.eye(4), torch.eye(3), 80, 60)
    frames = [Frame(str(i), i, camera) for i in range(5)]

    def told(seen):
        def view(i: int) -> View:
            mask = torch.full((60, 80), i in seen)
            return View(frames[i], scene_images(1, 0.01, seed=i)[0][..., None], mask=mask)

        return noise_of_views(ViewSet(frames, view), "thermal")

    assert told([3, 4]) == pytest.approx(0.01, rel=0.15) and told([]) == MIN_NOISE


def test_a_robust_spread_is_the_standard_deviation_without_what_lies_far_out_and_what_is_unknown():
    values = 0.3 * torch.randn(20_000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    values[:1000], values[1000:2000] = 50.0, torch.nan
    assert robust_spread(values) == pytest.approx(0.3, rel=0.12)
    assert robust_spread(-values) == robust_spread(values)
