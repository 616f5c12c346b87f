"""The yard of ``outdoor`` as no model here assumes it: cast shadows, layers, clouds, rain, reflected sky, a heated house.

What differs from ``outdoor``, all but the rain unknown to the methods: objects cast shadows on each other and hide the sky;
light of the sky is brighter about the sun, and the ground reflects; clouds warm the sky's long waves, and what is not sky is as
warm as the meadow; bodies have several layers, with rooms, a cabin or the deep ground behind them; rain falls, dew forms,
grass transpires; and the camera sees the sky and its neighbours mirrored in what does not emit. A method is told a weather
table as in ``outdoor``, and with it how much rain fell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import Weather
from heatsplat.datamodules.sun import split_irradiance
from heatsplat.datamodules.synthetic_scene import layered_heat
from heatsplat.datamodules.synthetic_scene.facade import FACADE, STONE, FacadeScene
from heatsplat.datamodules.synthetic_scene.layered_heat import VAPOUR_J_KG_K, Body, Course, Layer, Patches
from heatsplat.datamodules.synthetic_scene.outdoor import OUTDOOR, YARD, OutdoorPreset, OutdoorScene
from heatsplat.datamodules.synthetic_scene.outdoor_sky import (
    SITE,
    START_UTC_S,
    cloud_cover,
    clouds_of_light,
    outdoor_weather,
)
from heatsplat.datamodules.synthetic_scene.presets import Surface
from heatsplat.datamodules.synthetic_scene.scene import OnSurface
from heatsplat.datamodules.synthetic_scene.yard_light import Lighting
from heatsplat.physics.units import DAY_S, KELVIN_AT_0_C, STEFAN_BOLTZMANN

BODIES = {
    "meadow": Body((Layer(0.25, 1.4e6, 0.03), Layer(1.3, 2.3e6, 0.5)), 0.97, 8.0, 3.5, 12.0, 2.0, 0.5, 0.35),
    "road": Body((Layer(1.2, 2.0e6, 0.08), Layer(1.4, 1.8e6, 0.3)), 0.94, 6.0, 3.0, 13.0, 3.0),
    "terrace": Body((Layer(1.5, 2.1e6, 0.05), Layer(0.6, 1.5e6, 0.25)), 0.90, 5.5, 2.5, 13.0, 3.0),
    "house": Body(
        (Layer(0.8, 1.6e6, 0.015), Layer(0.04, 4e4, 0.08), Layer(0.6, 1.4e6, 0.175)), 0.92, 5.0, 2.5, 21.0, 7.7
    ),
    "roof": Body(
        (Layer(50.0, 3.6e6, 0.0015), Layer(0.14, 8e5, 0.024), Layer(0.04, 4e4, 0.12)), 0.80, 7.0, 3.5, 22.0, 7.7, 0.1
    ),
    "shed": Body((Layer(0.14, 8e5, 0.02),), 0.88, 6.0, 3.0, 20.0, 2.0, 0.2),
    "car": Body((Layer(45.0, 3.6e6, 0.001), Layer(0.05, 6e4, 0.015)), 0.86, 7.0, 4.0, 24.0, 3.0, 0.1),
    "tank": Body((Layer(16.0, 3.9e6, 0.003), Layer(20.0, 4.1e6, 0.3)), 0.90, 6.0, 3.0, 16.0, 0.0, 0.1),
}
SHOWERS = ((18.5, 19.5, 2.0), (38.0, 38.7, 3.0), (70.0, 74.0, 1.5), (113.0, 114.0, 4.0), (140.0, 141.5, 2.0))
"""Start and end in hours of the record, and millimetres an hour."""
MOST_DAYS = 7
OF_ANY_LENGTH = ("outdoor", "outdoor_true")  # yards whose record lasts as many days as asked for


@dataclass(frozen=True)
class TrueScenePreset(OutdoorPreset):
    """A yard with bodies; see ``OutdoorPreset``.

    Args:
        patch_m, ground_m: sizes of the patches that are solved, of objects and of the ground.
    """

    patch_m: float = 0.5
    ground_m: float = 1.0


TRUE_YARD = tuple(replace(surface, material=BODIES[surface.name]) for surface in YARD)


@dataclass(frozen=True)
class PatchHeat:
    """Four patches about each of n points, [n, 4], and their weights [n, 4], which are 0 where there is no surface."""

    patches: Tensor
    weights: Tensor


class OutdoorTrueScene(OutdoorScene):
    """A yard whose heat was solved patch by patch under a weather; see ``OutdoorScene``."""

    def _weather(self) -> Weather:
        return true_weather(self.preset.weather, self.preset.duration_s)

    def _solve(self) -> None:
        preset = self.preset
        self.light, self.course = _solved(
            preset.surfaces, preset.weather, preset.duration_s, preset.patch_m, preset.ground_m
        )
        self.sky = sky_of(preset.weather, self.weather)
        self.emissivity = torch.tensor([*(body.emissivity for body in self.materials), 1.0], dtype=torch.float64)

    def heat_at(  # type: ignore[override]
        self, points: Tensor, which: Tensor, parts: list[OnSurface] | None = None
    ) -> PatchHeat:
        """The patches about ``points`` [n, 3] that lie on the surfaces numbered ``which`` [n] (-1: none)."""
        patches = torch.zeros(len(points), 4, dtype=torch.int64)
        weights = torch.zeros(len(points), 4, dtype=torch.float64)
        for part in parts or self.parts(points, which):
            own = [face for face in self.light.faces if face.surface == part.number]
            nearest = (part.normals @ torch.stack([face.normal for face in own]).T).argmax(1)
            for k, face in enumerate(own):
                ids = (nearest == k).nonzero()[:, 0]
                patches[part.here[ids]], weights[part.here[ids]] = face.corners(part.on[ids])
        return PatchHeat(patches, weights)

    def celsius(self, heat: PatchHeat, times_s: Tensor) -> Tensor:  # type: ignore[override]
        """Temperatures [n, F] of surface points at ``times_s`` [F], in °C; ambient where there is no surface."""
        found = torch.empty(len(heat.patches), len(times_s), dtype=torch.float64)
        for column, time in enumerate(times_s.tolist()):
            kelvin = torch.from_numpy(self.course.at(time).astype(np.float64))
            found[:, column] = (kelvin[heat.patches] * heat.weights).sum(1) - KELVIN_AT_0_C
        return torch.where(heat.weights.sum(1, keepdim=True) > 0, found, self.preset.ambient_c)

    def facing(self, points: Tensor, which: Tensor, directions: Tensor, when: Tensor) -> Tensor:
        """As ``Scene.facing``; the sky is as warm as its radiance there says."""
        sky = self._sky_celsius(directions[:, 2], float(when))
        return torch.where(which < 0, sky, super().facing(points, which, directions, when))

    def _sky_celsius(self, sine: Tensor, time_s: float) -> Tensor:
        """Temperature [n] of a black body as bright as the sky at a height above the horizon: air seen through its slant.

        Its optical depth is that at which the hemisphere has the long waves of the sky (diffusivity factor 1.66).
        """
        air = float(np.interp(time_s, self.sky.times_s, self.sky.air_k))
        waves = float(np.interp(time_s, self.sky.times_s, self.sky.long_waves_w_m2))
        depth = -math.log(max(1.0 - waves / (STEFAN_BOLTZMANN * air**4), 1e-6)) / 1.66
        return air * (1.0 - torch.exp(-depth / sine.clamp(min=0.02))) ** 0.25 - KELVIN_AT_0_C

    def how_solved(self) -> str:
        return (
            f"{len(self.light.centres):,} patches of bodies in layers by the modes of finite volumes, sun ray-traced with cast "
            "shadows, diffuse light about the sun, albedo, clouds in long waves, rain, dew and transpiration, rooms behind "
            f"walls, mirrored sky in the images; weather: {self.preset.weather}"
        )

    def attributes(self, points: Tensor) -> dict[str, Tensor]:
        """True properties [n] of the surface nearest to each of ``points`` [n, 3], by name with unit; capacity is that of
        the first layer."""
        on_surface, which = self.nearest(points)
        wind = float(self.weather.wind_m_s.mean())
        absorbs = torch.zeros(len(points), dtype=torch.float64)
        for number, surface in enumerate(self.preset.surfaces):
            here = which == number
            absorbs[here] = surface.absorbs(surface.shape.local(on_surface[here])).clamp(0.0, 1.0)

        def by_surface(value) -> Tensor:
            return torch.tensor([value(body) for body in self.materials], dtype=torch.float64)[which]

        return {
            "absorptivity": absorbs,
            "emissivity": by_surface(lambda body: body.emissivity),
            "convection_w_m2_k": by_surface(lambda body: body.convection_still + body.convection_per_wind * wind),
            "heat_capacity_j_m3_k": by_surface(lambda body: body.layers[0].heat_capacity),
        }


def true_weather(name: str, duration_s: float) -> Weather:
    """The weather of ``outdoor`` over any number of days, with rain, and darker while it falls."""
    weather = outdoor_weather(name, 0.0, duration_s)
    times = weather.times_s.numpy()
    irradiance = weather.irradiance_w_m2.numpy() * (1.0 - 0.6 * _raining(times))
    direct, diffuse = split_irradiance(SITE, START_UTC_S + times, irradiance)
    light = {"irradiance_w_m2": irradiance, "direct_w_m2": direct, "diffuse_w_m2": diffuse}
    clouds = clouds_of_light(START_UTC_S + times, irradiance)
    rain = torch.from_numpy(rain_mm_h(times))
    return replace(
        weather, clouds=clouds, rain_mm_h=rain, **{key: torch.from_numpy(series) for key, series in light.items()}
    )


def _raining(times_s: np.ndarray) -> np.ndarray:
    """1 during showers, 0 without, [T]."""
    return (rain_mm_h(times_s) > 0).astype(np.float64)


def rain_mm_h(times_s: np.ndarray) -> np.ndarray:
    """Rain of the SHOWERS, [T]."""
    rain = np.zeros(len(times_s))
    for start, end, millimetres in SHOWERS:
        rain[(times_s >= 3600.0 * start) & (times_s <= 3600.0 * end)] = millimetres
    return rain


def sky_of(name: str, weather: Weather) -> layered_heat.Sky:
    """What the weather of a name does to all patches alike.

    Long waves of the clear sky by Prata (1996), with a cover c of black clouds c + (1 - c) of it, by night too. Rain falls from
    a closed cover.
    """
    times, air_k = weather.times_s.numpy(), weather.air_c.numpy() + KELVIN_AT_0_C
    saturated, _ = layered_heat.saturated_kg_m3(air_k)
    vapour = 0.01 * weather.humidity_percent.numpy() * saturated
    hpa = 0.01 * vapour * VAPOUR_J_KG_K * air_k
    moist = 46.5 * hpa / air_k
    clear = 1.0 - (1.0 + moist) * np.exp(-np.sqrt(1.2 + 3.0 * moist))
    cover = np.maximum(cloud_cover(name, times), _raining(times))
    return layered_heat.Sky(
        times,
        air_k,
        weather.wind_m_s.numpy(),
        vapour,
        rain_mm_h(times) / 3600.0,
        (cover + (1 - cover) * clear) * STEFAN_BOLTZMANN * air_k**4,
    )


@cache
def _solved(
    surfaces: tuple[Surface, ...], weather: str, duration_s: float, patch_m: float, ground_m: float
) -> tuple[Lighting, Course]:
    """Light and surface temperatures of all patches; every weather starts from the midnight after a fair first day."""
    light = Lighting([surface.shape for surface in surfaces], patch_m, ground_m)
    absorbs = torch.empty(len(light.centres), dtype=torch.float64)
    for number, surface in enumerate(surfaces):
        here = light.surface == number
        absorbs[here] = surface.absorbs(surface.shape.local(light.centres[here])).clamp(0.0, 1.0)
    bodies = [surface.material for surface in surfaces]
    ground = ((light.surface == 0) & ~light.covered).numpy()

    def course(name: str, seconds: float, start: Course | float) -> Course:
        record = true_weather(name, seconds)
        patches = Patches(
            light.surface.numpy(), absorbs.numpy(), light.sky_share.numpy(), light.sunlight(record), ground
        )
        return layered_heat.solve(bodies, patches, sky_of(name, record), start)

    midnight = course("fair", DAY_S, 288.0)
    return light, course(weather, duration_s, midnight)


TRUE = TrueScenePreset(surfaces=TRUE_YARD)
YARDS: dict[str, tuple[type[OutdoorScene], OutdoorPreset]] = {
    **{name: (OutdoorScene, preset) for name, preset in OUTDOOR.items()},
    "outdoor_true": (OutdoorTrueScene, TRUE),
    "facade": (FacadeScene, FACADE),
    "stone": (FacadeScene, STONE),
}
"""Scenes under the sky: how they are solved, and what they show."""
