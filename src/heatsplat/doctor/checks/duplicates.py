"""Frames that are another one once more."""

from __future__ import annotations

from heatsplat.doctor.base import Check, Finding, Material, some

SAME = 0.995  # share of pixels that are equal


def find(material: Material) -> list[Finding]:
    images = material.images
    same = [f for f in range(1, len(images)) if _alike(images[f - 1], images[f])]
    if not same:
        return []
    share = len(same) / len(images)
    return [
        Finding(
            "duplicates",
            0.1 * share + 0.01,
            f"{len(same)} of {len(images)} frames are the one before once more ({some([material.name(f) for f in same])}).",
            "Leave them out: the video repeats frames, or the image freezes while the shutter closes; their poses do not freeze.",
            tuple(material.name(f) for f in same),
        )
    ]


def _alike(one, other) -> bool:
    return int((one == other).sum()) > SAME * one.numel() and float(one.double().nan_to_num().std()) > 0


CHECK = Check("duplicates", "frames that equal the one before", find)
