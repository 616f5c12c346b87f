"""How many views see each point."""

from __future__ import annotations

import torch

from heatsplat.doctor.base import Check, Finding, Material
from heatsplat.effects.observations import in_view

MIN_VIEWS = 3
SHARE = 0.3  # of the points
SOME = 2000  # points that are looked at


def find(material: Material) -> list[Finding]:
    cameras = material.all_cameras or material.cameras or ()
    if material.points is None or len(material.points) < 20 or len(cameras) < MIN_VIEWS:
        return []
    points = material.points[:: max(1, len(material.points) // SOME)].double()
    seen = torch.zeros(len(points), dtype=torch.int64)
    for camera in cameras:
        seen += in_view(points, camera)
    few = float((seen < MIN_VIEWS).double().mean())
    if few < SHARE:
        return []
    return [
        Finding(
            "views",
            0.3 * few,
            f"{100 * few:.0f} % of the points lie in the view of fewer than {MIN_VIEWS} training frames "
            f"(median {int(seen.median())}).",
            "Record more overlap, or hold fewer frames out (data.split); what one view sees has no depth.",
        )
    ]


CHECK = Check("views", "how many views see each point", find)
