"""Fronts of houses in two calm winter nights after dull days: an insulated wall of a heated one, and what is wrong with it; and
an old one of thick stone that nobody heats, with the day between the nights.

Metres; x is east, y north, z up; the front faces south. Every body is solved through all its layers, with a room of 20 °C behind
walls (``layered_heat``; nothing of ``heatsplat.physics`` is used but constants). No dew falls, and what is not sky is as warm as
the air.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import SceneError, Weather
from heatsplat.datamodules.sun import clear_sky, clouds, split_irradiance, sun_directions
from heatsplat.datamodules.synthetic_scene import layered_heat
from heatsplat.datamodules.synthetic_scene.layered_heat import Body, Course, Layer, Patches
from heatsplat.datamodules.synthetic_scene.outdoor import (
    CLASSES,
    OutdoorPreset,
    OutdoorScene,
    OutdoorSurface,
    face_normals,
    shades_of,
)
from heatsplat.datamodules.synthetic_scene.outdoor_sky import SAMPLE_S, SITE, Sky, forcing_of, series
from heatsplat.datamodules.synthetic_scene.paths import looking
from heatsplat.datamodules.synthetic_scene.presets import Pattern
from heatsplat.datamodules.synthetic_scene.shapes import Box, Plane
from heatsplat.physics.units import DAY_S, KELVIN_AT_0_C
from heatsplat.training.rng import generator_for

START_UTC_S = 1705334400.0  # 2024-01-15, 16:00 UTC
DURATION_S = 40 * 3600.0  # two nights and the day between them
NIGHT_S = (3 * 3600.0, 15 * 3600.0)  # in which images are taken, from the start and a day later
_BEFORE_S = 6 * DAY_S  # of weather that walls have gone through
WINTER = Sky(warm_c=2.0, swing_k=3.0, dew_point_c=-3.0, cloud=2.0, wind_factor=0.3)
INDOOR_C = 20.0
INSIDE_W_M2_K = 1 / 0.13  # between a wall and the air of its room (ISO 6946, table 7)
OUTSIDE_M2_K_W = 0.04

PLASTER, INSULATION, BRICK, CONCRETE = (0.8, 1.6e6), (0.04, 4e4), (0.6, 1.4e6), (1.8, 2.1e6)  # k and ρ c
TUFF, LIMESTONE, GRANITE = (0.5, 1.1e6), (1.4, 1.9e6), (2.8, 2.2e6)
THICK_M = 0.9


def _stone(material: tuple[float, float]) -> Body:
    return Body((Layer(*material, THICK_M),), 0.93, 5.0, 2.5, WINTER.warm_c, INSIDE_W_M2_K)


def _wall(*layers: tuple[tuple[float, float], float]) -> Body:
    found = tuple(Layer(*material, metres) for material, metres in layers)
    return Body(found, 0.95, 5.0, 2.5, INDOOR_C, INSIDE_W_M2_K)


BODIES = {
    "ground": Body((Layer(1.4, 2.2e6, 0.5),), 0.95, 6.0, 3.0, 6.0, 2.0),
    "wall": _wall((PLASTER, 0.015), (INSULATION, 0.12), (BRICK, 0.175)),
    "thin insulation": _wall((PLASTER, 0.015), (INSULATION, 0.03), (BRICK, 0.265)),
    "no insulation": _wall((PLASTER, 0.015), (BRICK, 0.295)),
    "slab edge": _wall((PLASTER, 0.015), (CONCRETE, 0.25)),
    "left window": _wall(((0.05, 2.5e5), 0.025)),
    "right window": _wall(((0.05, 2.5e5), 0.025)),
    "door": _wall(((0.14, 8e5), 0.05)),
    "tuff": _stone(TUFF),
    "limestone": _stone(LIMESTONE),
    "granite": _stone(GRANITE),
}


def u_value(body: Body) -> float:
    """Thermal transmittance of a wall in W/(m² K)."""
    within = sum(layer.thickness_m / layer.conductivity for layer in body.layers)
    return 1.0 / (OUTSIDE_M2_K_W + within + 1.0 / body.back_w_m2_k)


def effusivity(body: Body) -> float:
    """√(k ρ c) in J/(m² K √s) of a body that the record does not heat through, NaN of another."""
    first = body.layers[0]
    reached_m = math.sqrt(first.conductivity / first.heat_capacity * DURATION_S)
    return math.sqrt(first.conductivity * first.heat_capacity) if first.thickness_m > reached_m else math.nan


def _part(name: str, x: tuple[float, float], z: tuple[float, float], absorbs: Pattern, color) -> OutdoorSurface:
    """Part of the front: a box that stands 2 cm out of the wall."""
    shape = Box((sum(x) / 2, 0.19, sum(z) / 2), (x[1] - x[0], 0.42, z[1] - z[0]))
    return OutdoorSurface(name, shape, BODIES[name], absorbs, color, label=CLASSES[0])


_PAINT = Pattern(0.45, 0.05, 1.5, 0.05, 0.6)
FRONT = (
    OutdoorSurface(
        "ground", Plane((0, 0, 0), (0, 0, 1)), BODIES["ground"], Pattern(0.7, 0.06, 3.0, 0.05, 1.1), (0.6, 0.6, 0.5),
        label=CLASSES[9],
    ),
    OutdoorSurface(
        "wall", Box((0.0, 0.2, 2.75), (10.0, 0.4, 5.5)), BODIES["wall"], _PAINT, (0.9, 0.85, 0.7), label=CLASSES[0]
    ),
    _part("thin insulation", (-4.2, -2.8), (3.4, 5.0), _PAINT, (0.9, 0.84, 0.7)),
    _part("no insulation", (2.6, 4.2), (3.4, 5.0), _PAINT, (0.9, 0.85, 0.69)),
    _part("slab edge", (-4.98, 4.98), (2.62, 2.88), _PAINT, (0.89, 0.85, 0.7)),
    _part("left window", (-3.6, -2.0), (0.9, 2.2), Pattern(0.5, 0.0, 1.0, 0.03, 0.4), (0.4, 0.5, 0.6)),
    _part("right window", (1.6, 3.2), (0.9, 2.2), Pattern(0.5, 0.0, 1.0, 0.03, 0.4), (0.4, 0.5, 0.6)),
    _part("door", (-0.6, 0.5), (0.0, 2.1), Pattern(0.6, 0.0, 1.0, 0.05, 0.35), (0.5, 0.35, 0.25)),
)  # fmt: skip
STONES = (
    FRONT[0],
    OutdoorSurface(
        "limestone", Box((0.0, 0.2, 2.75), (10.0, 0.4, 5.5)), BODIES["limestone"], _PAINT, (0.9, 0.85, 0.7), label=CLASSES[0]
    ),
    _part("granite", (-4.98, 4.98), (0.0, 1.2), Pattern(0.6, 0.05, 1.5, 0.05, 0.6), (0.6, 0.6, 0.65)),
    _part("tuff", (-3.0, -0.5), (2.4, 4.6), _PAINT, (0.85, 0.75, 0.5)),
)  # fmt: skip


@dataclass(frozen=True)
class FacadePreset(OutdoorPreset):
    """A front; see ``OutdoorPreset``.

    Args:
        filmed_s: when images are taken, from the start and a day later.
    """

    surfaces: tuple[OutdoorSurface, ...] = FRONT
    duration_s: float = DURATION_S
    filmed_s: tuple[float, float] = NIGHT_S
    ambient_c: float = 2.0
    point_noise_m: float = 0.01
    bounds_c: tuple[float, float] = (-12.0, 28.0)
    split: str = "every_8th"


FACADE = FacadePreset()
STONE = FacadePreset(
    surfaces=STONES,
    duration_s=2 * DAY_S,
    filmed_s=(1800.0, DAY_S - 1800.0),
    bounds_c=(-10.0, 20.0),
    effects=FACADE.effects | {"semi_infinite"},
)


class _History:
    """``layered_heat.Course`` as ``OutdoorScene`` asks for it."""

    def __init__(self, course: Course) -> None:
        self._course = course

    def at(self, times_s: np.ndarray) -> np.ndarray:
        return np.stack([self._course.at(float(time)) for time in times_s]).astype(np.float64)


class FacadeScene(OutdoorScene):
    """A front whose heat has been solved; see ``OutdoorScene``. Times are seconds from the start of the record."""

    probe_reach_m = 0.15

    def _weather(self) -> Weather:
        if self.preset.weather != FACADE.weather:
            raise SceneError(
                f"data.weather={self.preset.weather}: these fronts have the weather of two winter nights only"
            )
        return winter_weather(0.0, self.preset.duration_s)

    def _history(self) -> _History:  # type: ignore[override]
        return _History(_solved(self.preset.surfaces, self.preset.duration_s))

    def how_solved(self) -> str:
        return (
            f"conduction through {len(self.materials)} bodies in layers by the modes of finite volumes, a room behind "
            f"the walls at {INDOOR_C:g} °C, sun by orientation, wind, long waves of a clear winter sky"
        )

    def attributes(self, points: Tensor) -> dict[str, Tensor]:
        """True properties [n] of the surface nearest to each of ``points`` [n, 3], by name with unit; U is NaN on the ground,
        effusivity where the record reaches through the body."""
        on_surface, which = self.nearest(points)
        wind = float(self.weather.wind_m_s.mean())
        walls = [math.nan if s.name == "ground" else u_value(s.material) for s in self.preset.surfaces]

        def by_surface(values) -> Tensor:
            return torch.tensor(list(values), dtype=torch.float64)[which]

        return {
            "absorptivity": self.heat_at(on_surface, which).absorptivity,
            "emissivity": by_surface(body.emissivity for body in self.materials),
            "convection_w_m2_k": by_surface(b.convection_still + b.convection_per_wind * wind for b in self.materials),
            "effusivity_j_m2_k_s05": by_surface(effusivity(body) for body in self.materials),
            "u_value_w_m2_k": by_surface(walls),
        }

    def route(self, frames: int, seed: int) -> tuple[np.ndarray, Tensor]:
        """Times [F] on both days, and world-to-camera matrices [F, 4, 4] of a camera that goes to and fro before it."""
        draws = torch.rand(frames, 4, generator=generator_for(seed, 0, "facade"), dtype=torch.float64)
        number = torch.arange(frames, dtype=torch.float64)
        place = 2.0 * (number + 0.2 + 0.6 * draws[:, 0]) / frames
        nights, (first, last) = place.floor(), self.preset.filmed_s
        times = np.round((nights * DAY_S + first + (place - nights) * (last - first)).numpy(), 3)
        along = 5.0 * torch.sin(2.39996 * number + draws[:, 1])
        center = torch.stack([along, -8.5 - 1.5 * draws[:, 2], 1.2 + 3.6 * torch.remainder(0.618034 * number, 1.0)], 1)
        aim = torch.stack([0.35 * along, torch.zeros_like(along), 2.4 + 0.4 * (draws[:, 3] - 0.5)], 1)
        return times, looking(center, aim)


def winter_weather(start_s: float, end_s: float) -> Weather:
    """The weather every ten minutes, on the clock of the record; the same bits on every call."""
    times = np.arange(start_s, end_s + 0.5 * SAMPLE_S, SAMPLE_S)
    utc_s = START_UTC_S + times
    air, wind, humidity, passing = series(WINTER, times + START_UTC_S % DAY_S)
    irradiance = clear_sky(SITE, utc_s) * passing
    direct, diffuse = split_irradiance(SITE, utc_s, irradiance)
    columns = {
        "air_c": air,
        "wind_m_s": wind,
        "humidity_percent": humidity,
        "irradiance_w_m2": irradiance,
        "direct_w_m2": direct,
        "diffuse_w_m2": diffuse,
        "clouds": clouds(SITE, utc_s, irradiance),
        "sun": sun_directions(SITE, utc_s),
    }
    notes = {
        "source": "made up: two winter nights",
        "up": list(SITE.up),
        "north": list(SITE.north),
        "indoor_c": INDOOR_C,
    }
    return Weather(torch.from_numpy(times), **{k: torch.from_numpy(v) for k, v in columns.items()}, notes=notes)


@cache
def _solved(surfaces: tuple[OutdoorSurface, ...], duration_s: float) -> Course:
    """Surface temperatures of all faces in all their shades, after days of the same weather."""
    faces = [(number, normal) for number, surface in enumerate(surfaces) for normal in face_normals(surface.shape)]
    shades = [shades_of(surfaces[number].absorbs).numpy() for number, _ in faces]
    count = len(shades[0])
    body, normals = np.repeat([number for number, _ in faces], count), np.array([normal for _, normal in faces])
    up = np.array(SITE.up)

    def course(start_s: float, end_s: float, start: Course | float) -> Course:
        weather = winter_weather(start_s, end_s)
        given = forcing_of(weather, normals)
        sky_share = np.repeat(0.5 * (1.0 + normals @ up), count)
        patches = Patches(body, np.concatenate(shades), sky_share, np.repeat(given.sunlight_w_m2, count, axis=1))
        level = forcing_of(weather, up[None])
        none = np.zeros(len(level.times_s))
        sky = layered_heat.Sky(level.times_s, level.air_k, level.wind_m_s, none, none, level.long_waves_w_m2[:, 0])
        return layered_heat.solve([surface.material for surface in surfaces], patches, sky, start)

    return course(0.0, duration_s, course(-_BEFORE_S, 0.0, 10.0 + KELVIN_AT_0_C))
