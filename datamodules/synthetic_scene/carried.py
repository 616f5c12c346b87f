"""A hot ball that is carried through a scene: where it is, what it radiates onto surfaces, and how these answer."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from heatsplat.datamodules.synthetic_scene.heat import Material, Responses, Waveform, solved
from heatsplat.datamodules.synthetic_scene.shapes import Point, Shape, Sphere, dot, trace
from heatsplat.physics.units import KELVIN_AT_0_C, STEFAN_BOLTZMANN

# Rays towards the ball leave a surface this far off it, in metres.
_OFF_SURFACE_M = 1e-6


@dataclass(frozen=True)
class Carried:
    """A black ball on its way through a record, evenly from station to station.

    **Convention:** station k is reached k intervals after the start, the last one at the end of the record. What a surface
    gets is linear between its fluxes at two stations, which is the definition of the source, and so exact; in the interval
    before the record it rises from 0 to that of the first station.

    Args:
        stations: centres of the ball, in metres.
        radius_m: of the ball.
        celsius: its temperature.
    """

    stations: tuple[Point, ...]
    radius_m: float
    celsius: float

    def interval_s(self, duration_s: float) -> float:
        """Seconds from station to station."""
        return duration_s / (len(self.stations) - 1)

    def ball(self, progress: float) -> Sphere:
        """The ball when a share ``progress`` of the record has passed."""
        at = np.array(self.stations)
        place = np.clip(progress, 0.0, 1.0) * (len(at) - 1)
        center = [float(np.interp(place, np.arange(len(at)), at[:, axis])) for axis in range(3)]
        return Sphere(tuple(center), self.radius_m)

    def fluxes(self, points: Tensor, normals: Tensor, shapes: Sequence[Shape], ambient_c: float) -> Tensor:
        """Net flux [n, K] onto black surface points [n, 3] from the ball at each station, shadows included, in W/m².

        The view factor of a sphere that lies above the plane of the surface is (r / d)² cos θ; one that the plane cuts is
        taken for one that stands where its centre is.

        Args:
            normals: [n, 3] outward.
            shapes: what may stand between.
            ambient_c: what the surface would see in place of the ball.
        """
        excess = STEFAN_BOLTZMANN * ((self.celsius + KELVIN_AT_0_C) ** 4 - (ambient_c + KELVIN_AT_0_C) ** 4)
        result = points.new_zeros(len(points), len(self.stations))
        for k, station in enumerate(self.stations):
            to_ball = points.new_tensor(station) - points
            distance = dot(to_ball, to_ball).sqrt()
            facing = (dot(normals, to_ball) / distance).clamp_min(0.0)
            lit = facing.nonzero()[:, 0]
            blocked, _ = trace(shapes, points[lit] + _OFF_SURFACE_M * normals[lit], to_ball[lit])
            share = (self.radius_m / distance[lit].clamp_min(self.radius_m)) ** 2 * facing[lit]
            result[lit, k] = torch.where(blocked < 1.0, 0.0, excess * share)
        return result

    def responses(self, materials: Sequence[Material], duration_s: float) -> Responses:
        """How materials answer to a flux that rises to 1 W/m² within an interval and falls back within the next."""
        step = self.interval_s(duration_s)
        hat = Waveform((0.0, step, 2.0 * step), (0.0, 1.0, 0.0))
        return solved(tuple(materials), hat, duration_s + 2.0 * step)

    def rises(self, responses: Responses, times_s: np.ndarray, duration_s: float) -> np.ndarray:
        """Warming [F, K, m] of m materials at ``times_s`` [F] by 1 W/m² at each station, of ``responses``, in K/(W/m²)."""
        step = self.interval_s(duration_s)
        since = times_s[:, None] - step * (np.arange(len(self.stations)) - 1.0)
        warming = responses.at(since.clip(0.0).ravel())[..., 1].reshape(*since.shape, -1)
        return np.where(since[..., None] > 0.0, warming, 0.0)
