"""A camera that stands still: where it stands cannot be found in its images."""

from __future__ import annotations

from heatsplat.doctor.base import Check, Finding, Material

MIN_FRAMES = 3


def find(material: Material) -> list[Finding]:
    if material.cameras is not None or len(material.images) < MIN_FRAMES or not material.still:
        return []
    return [
        Finding(
            "still",
            1.0,
            f"All {len(material.names)} frames show the same image: the camera stood still, and from one place no depth can be "
            "told.",
            "Record from several places around the scene; poses=none prepares the temperatures without a search for cameras.",
        )
    ]


CHECK = Check("still", "whether the camera moved at all, where its poses are not known yet", find)
