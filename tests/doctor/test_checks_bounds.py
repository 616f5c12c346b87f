"""Pixels beyond their bounds and saturation are found."""

from dataclasses import replace

import torch
from materials import changed, checks, clean


def test_pixels_beyond_the_bounds_and_bounds_that_nothing_uses_are_found():
    assert "bounds" in checks(replace(clean(), clipped=0.05))
    assert "bounds" in checks(changed(clean(), 0.5 + 0.05 * clean().images))
    assert "bounds" in checks(replace(clean(), bounds_c=(12000.0, 19000.0)))


def test_saturation_is_found():
    assert "saturation" in checks(
        changed(clean(), clean().images.clamp(max=float(clean().images.quantile(0.97))), clipped=0.0)
    )


def test_images_that_are_constant_do_not_saturate():
    assert "saturation" not in checks(changed(clean(), torch.full_like(clean().images, 0.5), clipped=0.0))
