"""A yard over two days or more: a house, a shed, a car, a tank and a terrace under sun, wind and sky, seen by a drone.

Metres; x is east, y north, z up. Every face of an object is of one temperature per shade of its paint: no surface casts
a shadow on another, only its own orientation decides how the sun meets it, and a face that leans sees as much of its
surroundings (at air temperature) as it sees less of the sky. The sky's long waves follow air temperature and humidity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import ThermalRange, Weather
from heatsplat.datamodules.synthetic_scene.outdoor_heat import History, OutdoorMaterial, Slab, integrate, solve
from heatsplat.datamodules.synthetic_scene.outdoor_sky import DURATION_S, forcing_of, outdoor_weather, part_of
from heatsplat.datamodules.synthetic_scene.paths import looking
from heatsplat.datamodules.synthetic_scene.presets import Pattern, Preset, Surface
from heatsplat.datamodules.synthetic_scene.scene import OnSurface, Scene
from heatsplat.datamodules.synthetic_scene.shapes import Box, Plane
from heatsplat.physics.units import DAY_S, KELVIN_AT_0_C
from heatsplat.training.rng import generator_for

NIGHT_S = (19.7 * 3600.0, 27.4 * 3600.0)  # from half an hour after sunset to 20 minutes before sunrise
# Weather before the record, so that its start finds the surfaces in the middle of things and not at one temperature.
_BEFORE_S = 0.5 * DAY_S

# Names of the classes, in the order of ThermoGS's table 8.
CLASSES = (
    "building",
    "road",
    "vehicle",
    "grassland",
    "high vegetation",
    "sports field",
    "water",
    "farmland",
    "construction",
    "bare ground",
)

# From a sheet that follows every cloud to ground that takes a day: ρc·depth / (h + 4 ε σ T³) is 4 minutes for the roof
# and the better part of a day for the tank, and h·depth/k is 0.0003 for the roof and about 1 for the wooden shed.
METAL_ROOF = OutdoorMaterial(50.0, 3.6e6, 0.0015, 0.80, 7.0, 3.5)
BRICK = OutdoorMaterial(0.8, 1.5e6, 0.06, 0.92, 5.0, 2.5)
WOOD = OutdoorMaterial(0.16, 0.9e6, 0.015, 0.88, 6.0, 3.0)
ASPHALT = OutdoorMaterial(1.2, 2.0e6, 0.08, 0.94, 6.0, 3.0)
WET_GROUND = OutdoorMaterial(1.6, 2.9e6, 0.12, 0.96, 8.0, 3.5)
CAR_BODY = OutdoorMaterial(45.0, 3.6e6, 0.004, 0.86, 7.0, 4.0)
WATER_TANK = OutdoorMaterial(20.0, 4.1e6, 0.15, 0.90, 6.0, 3.0)  # water stirs itself
CONCRETE = OutdoorMaterial(1.5, 2.1e6, 0.10, 0.90, 5.5, 2.5)


@dataclass(frozen=True)
class OutdoorSurface(Surface):
    """An object with flat faces under the sky; ``absorbs`` is the absorbed share of sunlight over it.

    Args:
        material: an ``OutdoorMaterial``.
        label: one of ``CLASSES``.
    """

    material: OutdoorMaterial = WET_GROUND  # type: ignore[assignment]
    label: str = "building"


def _surface(name: str, shape: Box | Plane, material: OutdoorMaterial, absorbs: Pattern, color, label: str):
    return OutdoorSurface(name, shape, material, absorbs, color, label=label)


YARD = (
    _surface(
        "meadow", Plane((0, 0, 0), (0, 0, 1)), WET_GROUND, Pattern(0.72, 0.06, 6.0, 0.05, 3.1), (0.5, 0.75, 0.35), CLASSES[3]
    ),
    _surface(
        "road", Box((0.0, -9.0, 0.03), (24.0, 4.0, 0.14), 4.0), ASPHALT, Pattern(0.86, 0.03, 3.0, 0.04, 1.7),
        (0.55, 0.55, 0.6), CLASSES[1],
    ),
    _surface(
        "terrace", Box((6.5, -3.5, 0.1), (4.0, 4.0, 0.3), 20.0), CONCRETE, Pattern(0.6, 0.05, 2.0, 0.07, 1.1),
        (0.95, 0.9, 0.85), CLASSES[8],
    ),
    _surface(
        "house", Box((0.0, 0.5, 2.0), (9.0, 6.0, 4.0), 20.0), BRICK, Pattern(0.65, 0.06, 3.0, 0.06, 1.3), (0.9, 0.5, 0.4),
        CLASSES[0],
    ),
    _surface(
        "roof",
        Box((0.0, 0.5, 4.0), (8.98, 6.04 * 0.5**0.5, 6.04 * 0.5**0.5), 20.0, 45.0),
        METAL_ROOF,
        Pattern(0.5, 0.05, 2.5, 0.06, 1.4),
        (0.75, 0.8, 0.9),
        CLASSES[0],
    ),
    _surface(
        "shed", Box((-7.5, -2.0, 1.25), (3.0, 2.5, 2.5), -30.0), WOOD, Pattern(0.6, 0.06, 1.5, 0.06, 0.8), (0.85, 0.65, 0.4),
        CLASSES[8],
    ),
    _surface(
        "car", Box((3.0, -9.0, 0.85), (4.2, 1.8, 1.4), 4.0), CAR_BODY, Pattern(0.7, 0.05, 1.5, 0.08, 1.1), (0.3, 0.4, 0.9),
        CLASSES[2],
    ),
    _surface(
        "tank", Box((-7.0, 5.5, 1.0), (2.5, 2.5, 2.0), 55.0), WATER_TANK, Pattern(0.55, 0.05, 1.5, 0.06, 1.0),
        (0.9, 0.9, 0.9), CLASSES[6],
    ),
)  # fmt: skip


@dataclass(frozen=True)
class OutdoorPreset(Preset):
    """A scene under the sky.

    Args:
        weather: name of its weather in ``SKIES``.
        bounds_c: temperatures of black and white, the same in every weather, so that one model serves them all.
        labels: names of the classes.
        part_s: part of the solved record that is filmed, and whose weather is known, in seconds; None: all of it.
        hours: first and last hour of the day, in UTC, between which images are taken, past midnight where the second is the
            smaller; None: at all hours.
        split: rule by which frames are held out (``datamodules.splits``); json: the last day.
    """

    surfaces: tuple[OutdoorSurface, ...] = YARD
    duration_s: float = DURATION_S
    ambient_c: float = 18.0
    point_noise_m: float = 0.02
    effects: frozenset[str] = frozenset({"relaxation", "solar", "radiation", "convection"})
    weather: str = "fair"
    bounds_c: tuple[float, float] = (0.0, 70.0)
    labels: tuple[str, ...] = CLASSES
    part_s: tuple[float, float] | None = None
    hours: tuple[float, float] | None = None
    split: str = "json"


OUTDOOR: dict[str, OutdoorPreset] = {"outdoor": OutdoorPreset()}


@dataclass(frozen=True)
class OutdoorHeat:
    """What decides the temperature of n surface points over time.

    Args:
        face: [n] number of the flat face; -1 where there is no surface.
        absorptivity: [n] absorbed share of sunlight.
    """

    face: Tensor
    absorptivity: Tensor


class OutdoorScene(Scene):
    """A yard whose heat has been solved under a weather; see ``Scene``. Times are seconds from the start of the record."""

    probe_reach_m = 0.25

    def __init__(self, preset: OutdoorPreset) -> None:
        self.preset = preset
        self.shapes = [surface.shape for surface in preset.surfaces]
        self.transmits = torch.zeros(len(preset.surfaces) + 1, dtype=torch.float64)
        # To the camera, as after correction.
        self.emissivity = torch.ones(len(preset.surfaces) + 1, dtype=torch.float64)
        self.materials = [surface.material for surface in preset.surfaces]
        self.thermal_range = ThermalRange(*preset.bounds_c)
        self.weather = self._weather()
        self._solve()

    def _weather(self) -> Weather:
        """What drives the heat. Raises SceneError where the scene does not know the preset's weather."""
        weather = outdoor_weather(self.preset.weather, 0.0, self.preset.duration_s)
        return weather if self.preset.part_s is None else part_of(weather, self.preset.part_s)

    def _solve(self) -> None:
        """Sets what ``heat_at`` and ``celsius`` look temperatures up in."""
        # Faces in the order of the surfaces; of each its surface, its normal and the shades that it is solved for.
        surfaces = self.preset.surfaces
        faces = [(number, normal) for number, s in enumerate(surfaces) for normal in face_normals(s.shape)]
        self.face_surface = torch.tensor([number for number, _ in faces])
        self.face_normals = torch.tensor([normal for _, normal in faces], dtype=torch.float64)
        self.shades = torch.stack([shades_of(surfaces[number].absorbs) for number, _ in faces])
        self.history = self._history()

    def _history(self) -> History:
        """Temperatures of all faces in all their shades over time."""
        return _solved(self.preset.surfaces, self.preset.weather, self.preset.duration_s)

    def heat_at(  # type: ignore[override]
        self, points: Tensor, which: Tensor, parts: list[OnSurface] | None = None
    ) -> OutdoorHeat:
        """Face and absorptivity at ``points`` [n, 3] that lie on the surfaces numbered ``which`` [n] (-1: none)."""
        face = torch.full((len(points),), -1)
        absorptivity = torch.zeros(len(points), dtype=torch.float64)
        for part in parts or self.parts(points, which):
            own = (self.face_surface == part.number).nonzero()[:, 0]
            face[part.here] = own[(part.normals @ self.face_normals[own].T).argmax(1)]
            absorptivity[part.here] = part.absorbs
        return OutdoorHeat(face, absorptivity)

    def celsius(self, heat: OutdoorHeat, times_s: Tensor) -> Tensor:  # type: ignore[override]
        """Temperatures [n, F] of surface points at ``times_s`` [F], in °C; ambient where there is no surface."""
        count = self.shades.shape[1]
        solved = torch.from_numpy(self.history.at(times_s.numpy())).reshape(len(times_s), -1, count)
        face = heat.face.clamp_min(0)
        shades = self.shades[face]
        kelvin = torch.zeros(len(face), len(times_s), dtype=torch.float64)
        for k in range(count):  # Lagrange's polynomial through the solved shades
            weight = torch.ones_like(heat.absorptivity)
            for j in range(count):
                if j != k:
                    weight = weight * (heat.absorptivity - shades[:, j]) / (shades[:, k] - shades[:, j])
            kelvin += weight[:, None] * solved[:, face, k].T
        return torch.where((heat.face < 0)[:, None], self.preset.ambient_c, kelvin - KELVIN_AT_0_C)

    def how_solved(self) -> str:
        return (
            f"conduction into {len(set(self.materials))} materials by implicit finite volumes (grids differ by "
            f"{1e3 * self.history.error_k:.0f} mK before extrapolation), sun by orientation without cast shadows, wind, "
            f"long waves of a clear sky; weather: {self.preset.weather}"
        )

    def warmth(self, points: Tensor, which: Tensor, surface: Surface) -> Tensor:
        """Temperature [n] at noon of the first day, which differs between faces and shades."""
        return self.celsius(self.heat_at(points, which), torch.tensor([0.45 * DAY_S], dtype=torch.float64))[:, 0]

    def attributes(self, points: Tensor) -> dict[str, Tensor]:
        """True properties [n] of the surface nearest to each of ``points`` [n, 3], by name with unit."""
        on_surface, which = self.nearest(points)
        wind = float(self.weather.wind_m_s.mean())

        def by_surface(value) -> Tensor:
            return torch.tensor([value(m) for m in self.materials], dtype=torch.float64)[which]

        return {
            "absorptivity": self.heat_at(on_surface, which).absorptivity,
            "emissivity": by_surface(lambda m: m.emissivity),
            "convection_w_m2_k": by_surface(lambda m: m.convection_still + m.convection_per_wind * wind),
            "convection_still_w_m2_k": by_surface(lambda m: m.convection_still),
            "convection_per_wind_w_s_m3_k": by_surface(lambda m: m.convection_per_wind),
            "areal_heat_capacity_j_m2_k": by_surface(lambda m: m.areal_heat_capacity),
            "heat_capacity_j_m3_k": by_surface(lambda m: m.heat_capacity),
            "depth_m": by_surface(lambda m: m.depth_m),
            "biot": by_surface(lambda m: m.biot(wind)),
        }

    def labels(self, points: Tensor) -> Tensor:
        """Class [n] int64 of the surface nearest to each of ``points`` [n, 3], a position in ``CLASSES``."""
        _, which = self.nearest(points)
        return torch.tensor([self.preset.labels.index(surface.label) for surface in self.preset.surfaces])[which]

    def route(self, frames: int, seed: int) -> tuple[np.ndarray, Tensor]:
        """Times [F] and world-to-camera matrices [F, 4, 4] of a drone: a third of the frames on the last day.

        Successive frames look from directions 137.5° apart, so that every part of a day sees every side.
        """
        first = training_frames(frames)
        jitter = torch.rand(frames, generator=generator_for(seed, 0, "flight times"), dtype=torch.float64).numpy()
        days = self.preset.duration_s / DAY_S - 1.0  # before the last
        slot = np.concatenate([days * np.arange(first) / first, days + np.arange(frames - first) / (frames - first)])
        width = np.where(np.arange(frames) < first, days / first, 1.0 / (frames - first))
        times = np.round(DAY_S * at_hours(slot + width * (0.2 + 0.6 * jitter), self.preset.hours), 3)
        if self.preset.part_s is not None:
            start_s, end_s = self.preset.part_s
            times = np.round(start_s + (end_s - start_s) * (np.arange(frames) + 0.2 + 0.6 * jitter) / frames, 3)

        wobble = torch.rand(frames, 4, generator=generator_for(seed, 0, "flight path"), dtype=torch.float64)
        number = torch.arange(frames, dtype=torch.float64)
        azimuth = torch.deg2rad(number * 137.50776 + 25.0 * (wobble[:, 0] - 0.5))
        elevation = torch.deg2rad(36.0 + 22.0 * torch.remainder(number * 0.6180339887 + 0.2 * wobble[:, 1], 1.0))
        radius = 22.0 + 3.0 * (wobble[:, 2] - 0.5)
        aim = torch.tensor([0.0, -1.5, 1.5], dtype=torch.float64).expand(frames, 3)
        flat = radius * torch.cos(elevation)
        center = aim + torch.stack([flat * azimuth.sin(), -flat * azimuth.cos(), radius * elevation.sin()], dim=1)
        return times, looking(center, aim)


def at_hours(days: np.ndarray, hours: tuple[float, float] | None) -> np.ndarray:
    """Moments [n] that are spread over whole days, in days, as they lie between two ``hours`` of each day (UTC, 0 to 24) instead,
    in the same order; past midnight where the second hour is the smaller, and where they were without hours."""
    if hours is None:
        return days
    first, last = hours[0] / 24.0, hours[1] / 24.0
    share, whole = np.modf(days)
    if first < last:
        return whole + first + share * (last - first)
    place = share * (1.0 - first + last)  # until the last hour in the morning, then from the first on in the evening
    return whole + np.where(place < last, place, place - last + first)


def training_frames(frames: int) -> int:
    """How many of a record's frames are taken before its last day: two thirds, and at least one on that day."""
    return min(frames - frames // 3, frames - 1)


@cache
def _solved(surfaces: tuple[OutdoorSurface, ...], weather: str, duration_s: float) -> History:
    """Surface temperatures of all faces in all their shades; every weather starts from the same midnight."""
    slabs, normals = [], []
    for surface in surfaces:
        for normal in face_normals(surface.shape):
            slabs += [Slab(surface.material, float(a), len(normals)) for a in shades_of(surface.absorbs)]
            normals.append(normal)
    before = forcing_of(outdoor_weather("fair", -_BEFORE_S, 0.0), np.array(normals))
    # How the surfaces got to their state at midnight need not be converged: it defines the start.
    midnight = integrate(slabs, before, float(before.air_k.mean()), cells=20, steps=4).states_k
    return solve(slabs, forcing_of(outdoor_weather(weather, 0.0, duration_s), np.array(normals)), midnight)


def face_normals(shape: Box | Plane) -> list[tuple[float, float, float]]:
    """Outward normals of the flat faces of a shape that do not look down; those that do touch the ground."""
    if isinstance(shape, Plane):
        return [shape.normal]
    axes = shape.rotation()
    return [
        tuple(side * axes[:, axis].numpy()) for axis in range(3) for side in (1.0, -1.0) if side * axes[2, axis] > -0.5
    ]


def shades_of(absorbs: Pattern) -> Tensor:
    """The absorptivities [3] between which a face's temperature is interpolated: those of Chebyshev over its range."""
    reach = absorbs.swing + absorbs.step
    return absorbs.level + reach * torch.cos(math.pi * (torch.arange(3, dtype=torch.float64) + 0.5) / 3)


def in_weather(preset: OutdoorPreset, weather: str | None) -> OutdoorPreset:
    """The preset under another of its skies; None leaves it as it is."""
    return preset if weather is None else replace(preset, weather=weather)
