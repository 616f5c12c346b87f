"""Frames that are another one once more are found."""

import torch
from materials import changed, clean

from heatsplat.doctor.checks.duplicates import find


def test_a_frame_that_is_the_one_before_is_named():
    images = clean().images.clone()
    images[5] = images[4]
    (found,) = find(changed(clean(), images))
    assert found.frames == (clean().name(5),)
    assert find(clean()) == []


def test_frames_that_show_nothing_are_not_the_same_frame():
    assert find(changed(clean(), torch.zeros_like(clean().images))) == []
