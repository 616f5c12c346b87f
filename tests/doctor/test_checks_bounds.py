"""Pixels beyond their bounds and saturation are found."""

from dataclasses import replace

import torch
from materials import changed, checks, clean, findings_of


def test_pixels_beyond_the_bounds_and_bounds_that_nothing_uses_are_found():
    assert "bounds" in checks(replace(clean(), clipped=0.05), only="bounds")
    assert "bounds" in checks(changed(clean(), 0.5 + 0.05 * clean().images), only="bounds")
    assert "bounds" in checks(replace(clean(), bounds_c=(12000.0, 19000.0)), only="bounds")


def test_temperatures_that_are_kelvin_or_of_another_scale_are_found():
    unit = clean().images.double()
    for images, unit_k, bounds_c, said in (
        (unit, 34.0, (295.0, 329.0), "All pixels lie within 295 .. 329 °C, which may be kelvin of 21.85 .. 55.85 °C."),
        (295.0 + 20.0 * unit, 1.0, None, "which may be kelvin of"),
        (-80.0 + 18.0 * unit, 1.0, None, "°C (median)"),
    ):
        found = findings_of(replace(clean(), images=images, unit_k=unit_k, bounds_c=bounds_c), "bounds")
        assert any(said in f.what and "counts.scale" in f.remedy for f in found)
    day, furnace, sky_above_ground = 40.0 * unit, 500.0 * unit + 250.0, 300.0 * unit - 90.0
    for celsius in (day, furnace, sky_above_ground):
        assert "bounds" not in checks(replace(clean(), images=celsius, unit_k=1.0, bounds_c=None), only="bounds")


def test_saturation_is_found():
    assert "saturation" in checks(
        changed(clean(), clean().images.clamp(max=float(clean().images.quantile(0.97))), clipped=0.0), only="bounds"
    )


def test_images_that_are_constant_do_not_saturate():
    assert "saturation" not in checks(
        changed(clean(), torch.full_like(clean().images, 0.5), clipped=0.0), only="bounds"
    )
