"""Contrast that the camera stretched is found."""

import torch
from materials import changed, checks, clean

from heatsplat.doctor.checks.agc import _leaps


def test_contrast_that_the_camera_stretches_is_no_temperature():
    gain = 1.0 + 0.4 * torch.sin(3.0 * torch.arange(len(clean().images), dtype=torch.float64))
    middle = clean().images.mean()
    wild = (middle + gain[:, None, None] * (clean().images - middle)).clamp(0, 1)
    assert "agc" in checks(changed(clean(), wild), only="agc")
    greys = changed(clean(), wild, unit_k=None, bounds_c=None)  # that nobody calls temperatures
    assert "agc" not in checks(greys, only="agc")


def test_greys_that_all_reach_from_black_to_white_were_stretched_one_by_one():
    low, high = clean().images.amin((1, 2), keepdim=True), clean().images.amax((1, 2), keepdim=True)
    full = (clean().images - low) / (high - low)
    greys = (255.0 * full).round() / 255.0
    assert "agc" in checks(changed(clean(), greys, cameras=None, points=None), only="agc")
    # Temperatures whose warmest and coldest spots every frame shows are no pictures.
    assert "agc" not in checks(changed(clean(), full, cameras=None, points=None), only="agc")


def test_frames_in_celsius_have_no_black_and_white():
    winter = 30.0 * clean().images - 10.0
    unposed = {"unit_k": 1.0, "bounds_c": None, "cameras": None, "points": None}
    assert "agc" not in checks(changed(clean(), winter, **unposed), only="agc")


def test_mist_that_comes_and_goes_is_no_camera_that_stretches():
    images, middle = clean().images, clean().images.mean()
    for rate, found in ((0.8, False), (2.5, True)):
        gain = 1.0 + 0.4 * torch.sin(rate * torch.arange(len(images), dtype=torch.float64))
        seen = (middle + gain[:, None, None] * (images - middle)).clamp(0, 1)
        assert ("agc" in checks(changed(clean(), seen), only="agc")) == found


def test_a_steady_change_does_not_leap_over_a_gap_in_time():
    times = torch.tensor([0.0, 10.0, 20.0, 120.0, 130.0, 135.0], dtype=torch.float64)
    assert float(_leaps(1.0 - 0.002 * times, times).abs().max()) < 1e-12
    assert float(_leaps(1.0 - 0.002 * times, None).abs().max()) > 0.05
