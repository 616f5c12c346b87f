"""Frames that show nothing, such as the camera's own shutter."""

from __future__ import annotations

from heatsplat.doctor.base import Check, Finding, Material, some


def find(material: Material) -> list[Finding]:
    names = [material.name(f) for f in material.blank]
    if not names:
        return []
    share = len(names) / len(material.images)
    others, remedy = ", where the others show the scene", "Leave them out"
    if share == 1:
        others, remedy = "", "Record or export them again"
    return [
        Finding(
            "blank",
            min(1.0, share) + 0.02,
            f"{len(names)} of {len(material.images)} frames have one level all over ({some(names)}){others}.",
            f"{remedy}: the shutter was closed, or the file lost its image, and no surface is as they have it.",
            tuple(names),
        )
    ]


CHECK = Check("blank", "frames that show nothing", find)
