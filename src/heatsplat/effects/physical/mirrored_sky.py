"""The sky mirrored in what does not emit."""

from __future__ import annotations

from functools import partial

from heatsplat.effects.base import Effect, Part
from heatsplat.effects.weathered import MIRRORED, SIGMAS, around

EFFECT = Effect(
    name="mirrored_sky",
    stage="emission",
    place=3,
    summary="the sky, reflected by surfaces of low emissivity",
    source="Kirchhoff's law under a sky of one optical depth (Elsasser 1942)",
    needs=frozenset({"time", "thermal_range", "weather"}),
    null="reflected sky is not visible",
    threshold=SIGMAS,
    adds="a reflectance for each Gaussian, the sky in one direction",
    evidence=partial(around, name=MIRRORED),
    part=Part("path", "mirrored_sky"),
)
