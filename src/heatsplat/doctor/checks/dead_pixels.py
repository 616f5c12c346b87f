"""Pixels of the detector that do not work."""

from __future__ import annotations

from heatsplat.contracts import evenly_spread
from heatsplat.doctor.base import Check, Finding, Material
from heatsplat.physics.defects import dead_pixels

FRAMES = 8  # that are looked at
ENOUGH = 2  # a lone one may be a speck of the scene


def find(material: Material) -> list[Finding]:
    lens = [material.lenses[i] for i in material.chosen] if material.lenses else [0] * len(material.images)
    own = [f for f, number in enumerate(lens) if number == lens[0]]  # of one detector
    few = [own[i] for i in evenly_spread(len(own), FRAMES)]
    dead = dead_pixels(material.images[few].float())
    if material.masks is not None:
        dead &= material.masks[few].any(0)
    count = int(dead.sum())
    if count < ENOUGH:
        return []
    first = ", ".join(f"({x}, {y})" for y, x in dead.nonzero()[:4].tolist())
    share = count / dead.numel()
    return [
        Finding(
            "dead_pixels",
            min(1.0, 20.0 * share) + 0.01,
            f"{count} pixels differ from what is around them in nearly all frames, such as (x, y) = {first} in images of "
            f"{material.grid}.",
            "Leave them out with masks/<image name>.png (black where a pixel is dead); python src/prepare.py writes such masks.",
        )
    ]


CHECK = Check("dead_pixels", "pixels that differ from what is around them while the camera moves", find)
