"""Contrast that the camera stretched is found."""

import torch
from materials import changed, checks, clean


def test_contrast_that_the_camera_stretches_is_no_temperature():
    gain = 1.0 + 0.4 * torch.sin(3.0 * torch.arange(len(clean().images), dtype=torch.float64))
    middle = clean().images.mean()
    wild = (middle + gain[:, None, None] * (clean().images - middle)).clamp(0, 1)
    assert "agc" in checks(changed(clean(), wild))
    low, high = clean().images.amin((1, 2), keepdim=True), clean().images.amax((1, 2), keepdim=True)
    assert "agc" in checks(changed(clean(), (clean().images - low) / (high - low), cameras=None, points=None))
    assert "agc" not in checks(
        changed(clean(), wild, unit_k=None, bounds_c=None)
    )  # greys that nobody calls temperatures
