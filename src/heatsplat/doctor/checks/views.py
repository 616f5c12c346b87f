"""How many views see each point, and images that have no camera."""

from __future__ import annotations

import torch

from heatsplat.doctor.base import Check, Finding, Material
from heatsplat.effects.observations import in_view

MIN_VIEWS = 3
SHARE = 0.3  # of the points
FEW = 0.1  # of the images that may lack a camera
SOME = 2000  # points that are looked at


def find(material: Material) -> list[Finding]:
    cameras = material.all_cameras or material.cameras or ()
    found = _without_camera(material)
    if material.points is None or len(material.points) < 20 or not len(cameras):
        return found
    points = material.points[:: max(1, len(material.points) // SOME)].double()
    seen = torch.zeros(len(points), dtype=torch.int64)
    for camera in cameras:
        seen += in_view(points, camera)
    few = float((seen < MIN_VIEWS).double().mean())
    if few < SHARE:
        return found
    return [
        *found,
        Finding(
            "views",
            0.3 * few,
            f"{100 * few:.0f} % of the points lie in the view of fewer than {MIN_VIEWS} training frames "
            f"(median {int(seen.median())}).",
            "Record more overlap, or hold fewer frames out (data.split); what one view sees has no depth.",
        ),
    ]


def _without_camera(material: Material) -> list[Finding]:
    """Images that the model has no camera for, where they are more than a few."""
    lost, images = material.without_camera
    if lost <= FEW * images:
        return []
    return [
        Finding(
            "views",
            0.3 * lost / images,
            f"The model has no camera for {lost} of {images} images, which are left out of training: what only they show is "
            "missing.",
            "Record more overlap between the groups that do not connect, or find cameras by photos beside (poses=rgb); the "
            "report of a preparation says why each has none.",
        )
    ]


CHECK = Check("views", "how many views see each point, and how many images have no camera", find)
