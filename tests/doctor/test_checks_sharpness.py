"""Blurred frames are found."""

import torch
from materials import changed, clean, findings_of
from torch.nn import functional


def test_blurred_frames_are_found():
    images = clean().images.clone()
    for f in (4, 9):
        images[f] = functional.avg_pool2d(
            functional.pad(images[f][None, None], (4, 4, 0, 0), mode="replicate"), (1, 9), stride=1
        )
    found = findings_of(changed(clean(), images), "sharpness")
    assert found and {clean().name(4), clean().name(9)} <= set(found[0].frames)


def test_pixels_that_do_not_count_hide_no_blur():
    images = clean().images.clone()
    for f in (4, 9):
        images[f] = functional.avg_pool2d(
            functional.pad(images[f][None, None], (4, 4, 4, 4), mode="replicate"), 9, stride=1
        )
    celsius = 20.0 + 30.0 * images
    dead, masks = celsius.clone(), torch.ones_like(celsius, dtype=torch.bool)
    dead[:, 10:14, 10:14] = torch.nan
    masks[:, 10:14, 10:14] = False
    cut = celsius.where(masks, 0.0)
    for material in (changed(clean(), dead, unit_k=1.0), changed(clean(), cut, unit_k=1.0, masks=masks)):
        found = findings_of(material, "sharpness")
        assert found and {clean().name(4), clean().name(9)} <= set(found[0].frames)


def test_dead_pixels_hide_no_blur():
    """They are as sharp in a blurred frame, and the strongest gradients are theirs."""
    images = clean().images.clone()
    for f in (4, 9):
        images[f] = functional.avg_pool2d(
            functional.pad(images[f][None, None], (4, 4, 4, 4), mode="replicate"), 9, stride=1
        )
    for count in (1, 12):
        dead = images.clone()
        dead.flatten(1)[:, torch.randperm(dead[0].numel(), generator=torch.Generator().manual_seed(0))[:count]] = 1.5
        found = findings_of(changed(clean(), dead), "sharpness")
        assert found and found[0].frames == (clean().name(4), clean().name(9))
