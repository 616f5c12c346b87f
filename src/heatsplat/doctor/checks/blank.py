"""Frames that show nothing, such as the camera's own shutter."""

from __future__ import annotations

from heatsplat.doctor.base import Check, Finding, Material, some


def find(material: Material) -> list[Finding]:
    names = [material.name(f) for f in material.blank]
    if not names:
        return []
    share = len(names) / len(material.images)
    return [
        Finding(
            "blank",
            min(1.0, share) + 0.02,
            f"{len(names)} of {len(material.images)} frames have one level all over ({some(names)})"
            f"{', where the others show the scene' if share < 1 else ''}.",
            "Leave them out: the shutter was closed, or the file lost its image, and no surface is as they have it.",
            tuple(names),
        )
    ]


CHECK = Check("blank", "frames that show nothing", find)
