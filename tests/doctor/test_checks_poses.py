"""Cameras that are not those of the images are found."""

from dataclasses import replace

from materials import checks, clean

from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.doctor.base import material_of
from heatsplat.doctor.checks.poses import find


def test_poses_of_another_frame_are_found():
    cameras = list(clean().cameras)
    assert "poses" in checks(replace(clean(), cameras=cameras[5:] + cameras[:5]), only="poses")


def test_images_that_are_upside_down_against_their_poses_are_found():
    assert "poses" in checks(replace(clean(), images=clean().images.flip(1, 2)), only="poses")


def test_cameras_that_see_the_same_from_wide_apart_are_not_compared():
    """Night in a yard: cameras of one half hour look from 24° and more apart, at surfaces that face neither of them."""
    scene = Synthetic(scene="outdoor", size="tiny", frames=72, hours=(20, 4)).scene
    assert find(material_of(scene)) == []
