"""Cameras that are not those of the images are found."""

from dataclasses import replace

from materials import checks, clean


def test_poses_of_another_frame_are_found():
    cameras = list(clean().cameras)
    assert "poses" in checks(replace(clean(), cameras=cameras[5:] + cameras[:5]))


def test_images_that_are_upside_down_against_their_poses_are_found():
    assert "poses" in checks(replace(clean(), images=clean().images.flip(1, 2)))
