"""A preset whose heat has been solved: the temperature of every surface point at every time."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import ThermalRange, Weather
from heatsplat.datamodules.synthetic_scene import heat
from heatsplat.datamodules.synthetic_scene.presets import Preset, Surface
from heatsplat.datamodules.synthetic_scene.shapes import dot, nearest_surface, trace
from heatsplat.physics.planck import Band
from heatsplat.physics.units import KELVIN_AT_0_C, kelvin

# Where the visible light comes from (unit length), and its share that comes from everywhere.
_SUN = (-0.398, -0.597, 0.697)
_SKYLIGHT = 0.4
# Paint that absorbs all heat reflects this share of the colour that a bare surface does.
_DARKEST = 0.3
# Rays that leave a surface start this far off it, in metres: above rounding at any size, far below any pixel.
_OFF_SURFACE_M = 1e-6
# In which the camera sees: the long-wave window of uncooled detectors.
_BAND = Band(7.5, 14.0, nodes=12)


@dataclass(frozen=True)
class SurfaceHeat:
    """What decides the temperature of n surface points over time.

    Args:
        start_k: [n] excess over ambient at time 0.
        flux_w_m2: [n] absorbed flux when the source is at full level.
        material: [n] position of the material in ``Scene.materials``; -1 where there is no surface.
        waves_k: [n, w] parts of ``start_k`` that also level out sideways, or None where nothing flows sideways.
        levelling: [n, w] the rate at which each does, 1/s.
        carried_w_m2: [n, K] flux from the carried source at each of its stations, or None where there is none.
    """

    start_k: Tensor
    flux_w_m2: Tensor
    material: Tensor
    waves_k: Tensor | None = None
    levelling: Tensor | None = None
    carried_w_m2: Tensor | None = None

    def where(self, keep: Tensor) -> SurfaceHeat:
        """The heat of the points that ``keep`` selects."""
        return SurfaceHeat(*(None if values is None else values[keep] for values in vars(self).values()))


class OnSurface:
    """Points of a scene that lie on one of its surfaces.

    Attributes:
        number, surface: which.
        here: [m] positions among all points, increasing.
        on: [m, 3] the points.
    """

    def __init__(self, number: int, surface: Surface, here: Tensor, points: Tensor) -> None:
        self.number, self.surface, self.here, self.on = number, surface, here, points[here]

    @cached_property
    def local(self) -> Tensor:
        """The points [m, 3] in the axes of the surface's shape."""
        return self.surface.shape.local(self.on)

    @cached_property
    def normals(self) -> Tensor:
        """Outward unit normals [m, 3]."""
        return self.surface.shape.normals(self.on)

    @cached_property
    def absorbs(self) -> Tensor:
        """Absorbed share [m] of light, in [0, 1]."""
        return self.surface.absorbs(self.local).clamp(0.0, 1.0)


class Scene:
    """Geometry, materials and solved temperatures of a preset; float64 on the CPU.

    **Convention:** times are seconds from the start of the preset's record, 0 to ``preset.duration_s``.

    Attributes:
        route: how the camera moves: (frames, seed) -> (times [F], viewmats [F, 4, 4]); None for a hand that sweeps.
        weather: what drives the heat, on the clock of the record, or None indoors; such a scene has ``labels`` too.
        thermal_range: bounds of the camera's images; None for those that its frames need.
        probe_reach_m: how far about a probe its surface should be of one temperature.
    """

    route: Callable[[int, int], tuple[np.ndarray, Tensor]] | None = None
    weather: Weather | None = None
    thermal_range: ThermalRange | None = None
    probe_reach_m: float = 0.04

    _asked: tuple[Tensor, SurfaceHeat] | None = None  # points of the last ``truth``, and what warms them

    def __init__(self, preset: Preset) -> None:
        self.preset = preset
        self.shapes = [surface.shape for surface in preset.surfaces]
        # By number of surface; the last entry is that of -1, no surface.
        self.transmits = torch.tensor([*(surface.transmits for surface in preset.surfaces), 0.0], dtype=torch.float64)
        self.emissivity = torch.tensor([*(surface.emissivity for surface in preset.surfaces), 1.0], dtype=torch.float64)
        self.materials = list(dict.fromkeys(surface.material for surface in preset.surfaces))
        waveform = preset.lamp.waveform if preset.lamp else heat.CONSTANT
        self.responses = heat.solved(tuple(self.materials), waveform, preset.duration_s)
        self.carried_responses = preset.carried and preset.carried.responses(self.materials, preset.duration_s)
        if preset.bounds_c is not None:
            self.thermal_range = ThermalRange(*preset.bounds_c)

    def first_hits(self, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """First points [n, 3] on rays, and their surfaces [n]; the origin and -1 where there is none.

        Args:
            origins: [n, 3], or [1, 3] when all rays start at one point.
            directions: [n, 3].
        """
        distance, which = trace(self.shapes, origins, directions)
        missed = torch.isinf(distance)
        return origins + distance.masked_fill(missed, 0.0)[:, None] * directions, which.masked_fill(missed, -1)

    def beyond(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        """What ``first_hits`` finds on rays that go on from surface points [n, 3] along ``directions`` [n, 3]."""
        return self.first_hits(points + _OFF_SURFACE_M * directions, directions)

    def parts(self, points: Tensor, which: Tensor) -> list[OnSurface]:
        """Points [n, 3] on the surfaces numbered ``which`` [n] (-1: none), by surface; surfaces without points are left out.

        Who asks several things of the same points hands them on, and they are divided once.
        """
        order = which.argsort(stable=True)
        counts = torch.bincount(which + 1, minlength=len(self.shapes) + 1).tolist()
        of_each = enumerate(zip(self.preset.surfaces, order.split(counts)[1:], strict=True))
        return [OnSurface(number, surface, here, points) for number, (surface, here) in of_each if len(here)]

    def normals(self, points: Tensor, which: Tensor, parts: list[OnSurface] | None = None) -> Tensor:
        """Outward unit normals [n, 3] at ``points`` [n, 3] on the surfaces numbered ``which`` [n]; 0 where there is none."""
        result = torch.zeros_like(points)
        for part in parts or self.parts(points, which):
            result[part.here] = part.normals
        return result

    def heat_at(self, points: Tensor, which: Tensor, parts: list[OnSurface] | None = None) -> SurfaceHeat:
        """Start, flux and material at ``points`` [n, 3] that lie on the surfaces numbered ``which`` [n] (-1: none)."""
        result = SurfaceHeat(
            torch.zeros(len(points), dtype=torch.float64),
            torch.zeros(len(points), dtype=torch.float64),
            torch.full((len(points),), -1),
            *((points.new_zeros(len(points), 3), points.new_zeros(len(points), 3)) if self.preset.diffusivity else ()),
        )
        normals, reaching = torch.zeros_like(points), torch.zeros_like(result.flux_w_m2)
        parts = parts or self.parts(points, which)
        for part in parts:
            surface, here, on, local = part.surface, part.here, part.on, part.local
            result.material[here] = self.materials.index(surface.material)
            if surface.name in self.preset.start_k:
                start = self.preset.start_k[surface.name]
                result.start_k[here] = start(local)
                if self.preset.diffusivity:
                    across = surface.shape.local(on + part.normals) - local
                    result.waves_k[here] = start.waves(local)
                    result.levelling[here] = self.preset.diffusivity * start.wave_numbers(across) ** 2
            if self.preset.held:
                result.flux_w_m2[here] = surface.material.exchange * result.start_k[here]
            if self.preset.lamp:
                normals[here], reaching[here] = part.normals, self._lamp_flux(on, part.normals)
                result.flux_w_m2[here] = part.absorbs * reaching[here]
        if self.preset.lamp:  # one look for shadows from all surfaces
            lit = (reaching > 0).nonzero()[:, 0]
            to_lamp = points.new_tensor(self.preset.lamp.position) - points[lit]
            blocked, _ = trace(self.shapes, points[lit] + _OFF_SURFACE_M * normals[lit], to_lamp)
            result.flux_w_m2[lit[blocked < 1.0]] = 0.0
        if self.preset.carried is None:
            return result
        there = which >= 0
        fluxes = points.new_zeros(len(points), len(self.preset.carried.stations))
        on, normals = points[there], self.normals(points, which, parts)[there]
        fluxes[there] = self.preset.carried.fluxes(on, normals, self.shapes, self.preset.ambient_c)
        return replace(result, carried_w_m2=fluxes)

    def _lamp_flux(self, points: Tensor, normals: Tensor) -> Tensor:
        """Flux [n] that the lamp at full level sends onto ``points`` [n, 3] if nothing stands between, in W/m²."""
        lamp = self.preset.lamp
        position, aim = points.new_tensor(lamp.position), points.new_tensor(lamp.aim)
        to_lamp = position - points
        distance = dot(to_lamp, to_lamp).sqrt()
        facing = dot(normals, to_lamp) / distance
        axis = aim - position
        off_axis = torch.acos((-(to_lamp @ axis) / (distance * axis.norm())).clamp(-1.0, 1.0))
        edge = math.radians(lamp.half_angle_deg)
        beam = torch.sigmoid((edge - off_axis) / (0.1 * edge))
        return lamp.flux_w_m2 * (axis.norm() / distance) ** 2 * facing.clamp_min(0.0) * beam

    def celsius(self, surface: SurfaceHeat, times_s: Tensor) -> Tensor:
        """Temperatures [n, F] of surface points at ``times_s`` [F], in °C; ambient where there is no surface."""
        response = torch.from_numpy(self.responses.at(times_s.numpy()))
        of_point = response[:, surface.material.clamp_min(0)]
        start = surface.start_k
        if surface.waves_k is not None:  # (W cos) e^{-D q² t}: heat that flows along an endless sheet
            levelled = torch.exp(-surface.levelling * times_s[:, None, None]) - 1.0
            start = start + (levelled * surface.waves_k).sum(-1)
        rise = of_point[..., 0] * start + of_point[..., 1] * surface.flux_w_m2
        if surface.carried_w_m2 is not None:
            carried, duration_s = self.preset.carried, self.preset.duration_s
            warming = torch.from_numpy(carried.rises(self.carried_responses, times_s.numpy(), duration_s))
            for row, of_station in zip(rise, warming, strict=True):
                row += (of_station.T[surface.material.clamp_min(0)] * surface.carried_w_m2).sum(1)
        return self.preset.ambient_c + rise.T

    def in_front(self, origin: Tensor, directions: Tensor, points: Tensor, which: Tensor, time_s: float) -> Tensor:
        """Which rays [n] bool meet the carried source before ``points`` [n, 3], what they meet else (``first_hits``).

        Args:
            origin: [1, 3] where all rays start.
            time_s: seconds from the start of the record.
        """
        if self.preset.carried is None:
            return torch.zeros(len(directions), dtype=torch.bool)
        distance = self.preset.carried.ball(time_s / self.preset.duration_s).intersect(origin, directions)
        beyond = dot(points - origin, directions) / dot(directions, directions)
        return distance < torch.where(which < 0, math.inf, beyond)

    @property
    def mirrors(self) -> bool:
        """Whether a surface is no black body."""
        return bool((self.emissivity < 1.0).any())

    def apparent(self, celsius: Tensor, points: Tensor, which: Tensor, sight: Tensor, time_s: float) -> Tensor:
        """What a camera takes for the temperature [n] of ``celsius`` [n] at points [n, 3] that it sees along ``sight`` [n, 3].

        Args:
            which: [n] surfaces of the points; where there is none (-1), T is what is seen.
            sight: [n, 3] unit vectors from the camera, in the world.
            time_s: seconds from the start of the record.
        """
        bright = (self.emissivity[which] < 1.0).nonzero()[:, 0]
        if len(bright):
            celsius = celsius.index_put((bright,), self._mirroring(celsius, points, which, sight, time_s, bright))
        gloss, ambient = self.preset.gloss, self.preset.ambient_c
        if gloss is None:
            return celsius
        return ambient + gloss.apparent(celsius - ambient, -sight, self.normals(points, which))

    def _mirroring(
        self, celsius: Tensor, points: Tensor, which: Tensor, sight: Tensor, time_s: float, bright: Tensor
    ) -> Tensor:
        """How warm a camera takes the points ``bright`` [m] for, in °C [m]: opaque grey bodies that mirror what they face.

        B(apparent) = ε B(T) + (1 - ε) B(T_m), with the radiance B of black bodies in the camera's band (Planck) and the
        temperature T_m of what the mirrored ray meets first: a black body there (one mirror is seen, not a mirror in a
        mirror), or the surroundings at ambient temperature.
        """
        on, surface, when = points[bright], which[bright], torch.tensor([time_s], dtype=torch.float64)
        normals = self.normals(on, surface)
        mirrored = sight[bright] - 2.0 * dot(sight[bright], normals)[:, None] * normals
        met, met_surface = self.first_hits(on + _OFF_SURFACE_M * normals, mirrored)
        facing = self.facing(met, met_surface, mirrored, when)
        own, others = (_BAND.radiance(kelvin(t)) for t in (celsius[bright], facing))
        return _BAND.temperature(torch.lerp(others, own, self.emissivity[surface])) - KELVIN_AT_0_C

    def facing(self, points: Tensor, which: Tensor, directions: Tensor, when: Tensor) -> Tensor:
        """How warm mirrored rays [n, 3] find what they first meet, or the surroundings, in °C [n]; as ``first_hits`` has it."""
        return self.celsius(self.heat_at(points, which), when)[:, 0]

    def grey_bodies(self, points: Tensor) -> dict[str, Tensor]:
        """Emissivity and reflectance [n] of the surface nearest to each of ``points`` [n, 3]."""
        emissivity = self.emissivity[self.nearest(points)[1]]
        return {"emissivity": emissivity, "reflectance": 1.0 - emissivity}

    def attributes(self, points: Tensor) -> dict[str, Tensor]:
        """What the surface nearest to each of ``points`` [n, 3] is made of, by name with unit, each [n]."""
        which = self.nearest(points)[1]
        names = {
            "conductivity_w_m_k": "conductivity",
            "heat_capacity_j_m3_k": "heat_capacity",
            "depth_m": "depth_m",
            "exchange_w_m2_k": "exchange",
        }
        known = {
            name: torch.tensor([getattr(one.material, key) for one in self.preset.surfaces], dtype=torch.float64)[which]
            for name, key in names.items()
        }
        return known | {"emissivity": self.emissivity[which], "reflectance": 1.0 - self.emissivity[which]}

    def how_solved(self) -> str:
        """A sentence about the truth, for reports."""
        return (
            f"conduction into {len(self.materials)} materials by implicit finite volumes, converged to "
            f"{1e3 * self.responses.error:.2f} mK; linear exchange with the surroundings"
        )

    def warmth(self, points: Tensor, which: Tensor, surface: Surface) -> Tensor:
        """What tells points [n, 3] of ``surface`` apart that warm differently: start and flux, in kelvin [n]."""
        heat = self.heat_at(points, which)
        return heat.start_k + heat.flux_w_m2 / surface.material.exchange

    def nearest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """The surface nearest to each point: the point on it [n, 3] and its number [n]."""
        return nearest_surface(self.shapes, points.to("cpu", torch.float64))

    def truth(self, points: Tensor, times_s: Tensor) -> Tensor:
        """Temperatures [n, F] of the surface nearest to each of ``points`` [n, 3] at ``times_s`` [F], in °C."""
        # Of the same points one asks for many moments.
        if self._asked is None or not torch.equal(points, self._asked[0]):
            self._asked = points.clone(), self.heat_at(*self.nearest(points))
        return self.celsius(self._asked[1], times_s.to("cpu", torch.float64).reshape(-1))

    def color(self, points: Tensor, which: Tensor, parts: list[OnSurface] | None = None) -> Tensor:
        """Colour [n, 3] in [0, 1] that surface points reflect: Lambertian, dark where the paint absorbs heat."""
        color, sun = torch.zeros_like(points), points.new_tensor(_SUN)
        for part in parts or self.parts(points, which):
            daylight = _SKYLIGHT + (1 - _SKYLIGHT) * (part.normals @ sun).clamp_min(0.0)
            albedo = 1 - (1 - _DARKEST) * part.absorbs
            color[part.here] = (albedo * daylight)[:, None] * points.new_tensor(part.surface.color)
        return color

    def visible(
        self, points: Tensor, which: Tensor, directions: Tensor, parts: list[OnSurface] | None = None
    ) -> Tensor:
        """Colour [n, 3] in [0, 1] seen along rays that first meet ``points`` [n, 3] on surfaces ``which`` [n].

        A surface that transmits light adds its own colour to that of what lies behind it.
        """
        color = self.color(points, which, parts)
        share = self.transmits[which]
        clear = share.nonzero()[:, 0]
        if len(clear):
            onwards = directions[clear]
            behind = self.visible(*self.beyond(points[clear], onwards), onwards)
            color[clear] = torch.lerp(color[clear], behind, share[clear, None])
        return color
