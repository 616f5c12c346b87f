"""Points that few views see are found."""

from dataclasses import replace

import torch
from materials import checks, clean, findings_of


def test_points_that_few_views_see_are_found():
    far = torch.cat([clean().points, clean().points + torch.tensor([50.0, 0.0, 0.0])])
    assert "views" in checks(replace(clean(), points=far), only="views")


def test_views_that_are_fewer_than_a_point_needs_are_found():
    assert "views" not in checks(clean(), only="views")
    two = replace(clean(), cameras=clean().cameras[:2], all_cameras=clean().all_cameras[:2])
    (finding,) = findings_of(two, "views")
    assert finding.what.startswith("100 % of the points")


def test_images_without_a_camera_are_found():
    assert "views" not in checks(replace(clean(), without_camera=(1, 20)), only="views")
    (finding,) = findings_of(replace(clean(), without_camera=(4, 8)), "views")
    assert finding.what.startswith("The model has no camera for 4 of 8 images")
