"""A camera that stands still, before its poses are known."""

from dataclasses import replace

import pytest
import torch
from materials import checks, clean

from heatsplat.contracts import Camera
from heatsplat.doctor.base import Material


def tripod(levels, noise=0.05, frames=12):
    """What a camera on a tripod films of a wall: the same image with noise, with a level for each frame, °C."""
    generator = torch.Generator().manual_seed(0)
    y, x = torch.meshgrid(torch.arange(48.0), torch.arange(60.0), indexing="ij")
    wall = (20.0 + 3.0 * torch.sin(x / 5.0) * torch.cos(y / 7.0) + 0.05 * x).double()
    images = torch.stack([wall + level for level in levels[:frames]])
    images = images + noise * torch.randn(images.shape, generator=generator, dtype=torch.float64)
    names = [f"f{i:02d}" for i in range(len(images))]
    return Material(names, None, list(range(len(images))), images, unit_k=1.0)


def test_a_tripod_is_told_before_cameras_are_searched_for():
    steady = tripod([0.0] * 12)
    assert checks(steady) == ["still"]
    camera = Camera(torch.eye(4), torch.tensor([[50.0, 0, 30], [0, 50.0, 24], [0, 0, 1]]), 60, 48)
    assert checks(replace(steady, cameras=[camera] * 12)) == []  # whose poses are known
    unknown = steady.images.clone()
    unknown[3, :5] = torch.nan
    assert "still" in checks(replace(steady, images=unknown))


@pytest.mark.parametrize("scene", ["static", "cooling", "heated", "swung"])
def test_a_camera_that_moves_is_none(scene):
    moved = clean(scene)
    assert "still" not in checks(replace(moved, cameras=None))


def test_images_of_noise_do_not_stand_still():
    flat = tripod([0.0] * 12)
    noise = 20.0 + 0.05 * torch.randn(
        flat.images.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    assert "still" not in checks(replace(flat, images=noise))


def test_the_drift_of_a_sensor_shows_from_a_tripod_too():
    saw = [0.2 * (i % 6) for i in range(18)]
    found = tripod(saw, frames=18)
    assert checks(found) == ["still", "drift"]
    warm = tripod([0.0] * 18, frames=18)
    assert checks(warm) == ["still"]
