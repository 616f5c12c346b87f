"""Rooms furnished at random: as many other scenes as are wanted, to learn from what the preset ones are not to give away."""

from __future__ import annotations

import math

import torch

from heatsplat.datamodules.synthetic_scene.presets import (
    ALUMINIUM,
    CERAMIC,
    LINOLEUM,
    PLASTER,
    PLASTIC,
    RUBBER,
    STEEL,
    WOOD,
    Pattern,
    Preset,
    Surface,
)
from heatsplat.datamodules.synthetic_scene.shapes import Box, Cylinder, Plane, Point, Shape, Sphere
from heatsplat.training.rng import generator_for

ROOM = "room_"  # what their names begin with; a number follows
_MATERIALS = (ALUMINIUM, CERAMIC, PLASTIC, RUBBER, STEEL, WOOD)
_PLACES = tuple((x, y) for y in (-0.4, 0.0, 0.4) for x in (-0.6, -0.2, 0.2, 0.6))


def number_of(name: str, begins: str) -> int | None:
    """The number in the name of a scene that begins so (``ROOM``), or None for another name."""
    number = name.removeprefix(begins)
    return int(number) if name.startswith(begins) and number.isdecimal() else None


def room(number: int) -> Preset:
    """Floor, three walls and four to eight objects that are held warm; the same bits for the same number.

    Objects stand on a grid of places, turned and of any size that fits; every surface has its own level, smooth waves and
    tiles of 5 to 40 cm.
    """
    generator = generator_for(number, 0, "random room")

    def draw(low: float, high: float) -> float:
        return low + (high - low) * torch.rand((), generator=generator, dtype=torch.float64).item()

    def pattern(low: float, high: float) -> Pattern:
        tile = 0.05 * 8.0 ** draw(0.0, 1.0)
        return Pattern(draw(low, high), draw(1.0, 7.0), draw(0.3, 1.3), draw(0.5, 4.0) * (draw(0, 1) < 0.8), tile)

    def color() -> Point:
        return draw(0.3, 0.9), draw(0.3, 0.9), draw(0.3, 0.9)

    def shape(x: float, y: float) -> Shape:
        kind, half, height = draw(0.0, 3.0), draw(0.08, 0.17), draw(0.15, 0.7)
        if kind < 1:
            return Box((x, y, 0.5 * height), (2 * half * 0.8, 2 * half * draw(0.6, 0.8), height), draw(-45.0, 45.0))
        return Sphere((x, y, half), half) if kind < 2 else Cylinder((x, y, 0.0), half, height)

    planes = {
        "floor": (Plane((0, 0, 0), (0, 0, 1)), LINOLEUM),
        "wall": (Plane((0, 1.0, 0), (0, -1, 0)), PLASTER),
        "left_wall": (Plane((-1.7, 0, 0), (1, 0, 0)), PLASTER),
        "right_wall": (Plane((1.7, 0, 0), (-1, 0, 0)), PLASTER),
    }
    surfaces = [
        Surface(name, plane, material, pattern(0.4, 0.6), color()) for name, (plane, material) in planes.items()
    ]
    start = {name: pattern(4.0, 20.0) for name in planes}
    taken = torch.randperm(len(_PLACES), generator=generator)[: 4 + math.floor(draw(0.0, 5.0))].tolist()
    for i, place in enumerate(taken):
        name, material = f"object_{i}", _MATERIALS[math.floor(draw(0.0, len(_MATERIALS)))]
        surfaces.append(Surface(name, shape(*_PLACES[place]), material, Pattern(0.5, 0.2, 0.4), color()))
        start[name] = pattern(8.0, 40.0)
    return Preset(start_k=start, held=True, surfaces=tuple(surfaces))
