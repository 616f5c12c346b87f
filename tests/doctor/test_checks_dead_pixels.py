"""Dead pixels are found."""

import torch
from materials import changed, clean

from heatsplat.doctor.checks.dead_pixels import find


def test_pixels_that_never_follow_the_scene_are_found_where_they_are():
    images = clean().images.clone()
    images[:, 3, 4], images[:, 20, 30], images[:, 40, 9] = 1.0, 0.0, 1.0
    found = find(changed(clean(), images))
    assert found[0].what.startswith("3 pixels") and "(4, 3)" in found[0].what and "(30, 20)" in found[0].what
    height, width = images.shape[1:]
    assert found[0].what.endswith(f"in images of {width}x{height}.")
    assert find(clean()) == []


def test_pixels_that_a_mask_leaves_out_are_no_finding():
    images, masks = clean().images.clone(), torch.ones_like(clean().images, dtype=torch.bool)
    images[:, 3, 4], images[:, 20, 30] = 1.0, 0.0
    masks[:, 3, 4], masks[:, 20, 30] = False, False
    assert find(changed(clean(), images, masks=masks)) == []
