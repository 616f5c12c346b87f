"""Heat of surfaces under the open sky, solved numerically: sun, air, wind, the sky's long waves, conduction inwards.

Every surface is a slab of one material, insulated behind:

    ρc ∂T/∂t = k ∂²T/∂x²,    -k ∂T/∂x = α G(t) + h(t) (T_air(t) - T) + ε (L(t) - σ T⁴) at x = 0,    ∂T/∂x = 0 at x = depth,

with G the sunlight on the surface, L the long waves that reach it and h = still + per_wind · wind. Finite volumes about
nodes in depth (the first node is the surface itself, so that its T⁴ needs no iteration) and a linearly implicit method
in time; no linearisation about a mean, no exponential and no closed form is used, which makes this an independent check
of ``heatsplat.physics``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg.lapack import dgttrf, dgttrs

from heatsplat.physics.units import STEFAN_BOLTZMANN

# Of the two-stage, second-order, L-stable Rosenbrock method ROS2 (Verwer et al., SIAM J. Sci. Comput. 20, 1999).
_GAMMA = 1.0 - 0.5**0.5
# Depths of the nodes are graded by this power: a day's wave is steepest at the surface.
_DEPTH_GRADING = 2.0
_LEVELS = 4


@dataclass(frozen=True)
class OutdoorMaterial:
    """What a surface under the sky is made of.

    Args:
        conductivity: k in W/(m K).
        heat_capacity: volumetric ρc in J/(m³ K).
        depth_m: thickness of the slab, in metres.
        emissivity: of long waves, in [0, 1].
        convection_still: h without wind, in W/(m² K).
        convection_per_wind: what a metre per second of wind adds to it, in W s/(m³ K).
    """

    conductivity: float
    heat_capacity: float
    depth_m: float
    emissivity: float
    convection_still: float
    convection_per_wind: float

    @property
    def areal_heat_capacity(self) -> float:
        """Heat that a square metre of the whole slab takes per kelvin, in J/(m² K)."""
        return self.heat_capacity * self.depth_m

    def biot(self, wind_m_s: float) -> float:
        """h · depth / k: far below 1 the slab is of one temperature, so that a model without depth is exact."""
        # Radiation adds 4 ε σ T³, which is 6.1 ε at 27 °C.
        h = self.convection_still + self.convection_per_wind * wind_m_s + 6.1 * self.emissivity
        return h * self.depth_m / self.conductivity


@dataclass(frozen=True)
class Slab:
    """One piece of surface: its material, the absorbed share of sunlight, and which of ``Forcing``'s faces it is."""

    material: OutdoorMaterial
    absorptivity: float
    face: int


@dataclass(frozen=True)
class Forcing:
    """What drives the slabs; everything is linear between samples.

    Args:
        times_s: [T] increasing.
        air_k: [T] air temperature.
        wind_m_s: [T].
        sunlight_w_m2: [T, F] irradiance on each face.
        long_waves_w_m2: [T, F] long-wave irradiance on each face.
    """

    times_s: np.ndarray
    air_k: np.ndarray
    wind_m_s: np.ndarray
    sunlight_w_m2: np.ndarray
    long_waves_w_m2: np.ndarray


@dataclass(frozen=True)
class History:
    """Surface temperatures of m slabs over time.

    Args:
        times_s: [n] nodes, four or a multiple of equal steps between two samples of the forcing.
        surface_k: [n, m].
        error_k: largest change of the last refinement; infinite where none was made.
        states_k: [m, cells + 1] temperatures in depth at the end.
    """

    times_s: np.ndarray
    surface_k: np.ndarray
    states_k: np.ndarray
    error_k: float = float("inf")

    def at(self, times_s: np.ndarray) -> np.ndarray:
        """Surface temperatures [F, m] in kelvin at ``times_s`` [F] within the record."""
        times_s = np.asarray(times_s, dtype=np.float64)
        first, last = self.times_s[0], self.times_s[-1]
        if times_s.size and not (times_s.min() >= first - 1e-6 and times_s.max() <= last + 1e-6):
            raise ValueError(
                f"heat is solved for {first:g} .. {last:g} s of this scene; asked for {times_s.min():g} .. "
                f"{times_s.max():g} s"
            )
        # A quartic through the nodes of four steps, between which the forcing has no kink. (Rates of change at the nodes
        # would be of no use: those of a thin first volume are all rounding.)
        block = np.clip(np.searchsorted(self.times_s, times_s, side="right") - 1, 0, len(self.times_s) - 2) // 4 * 4
        x = 4.0 * (times_s - self.times_s[block]) / (self.times_s[block + 4] - self.times_s[block])
        result = np.zeros((len(times_s), self.surface_k.shape[1]))
        for k in range(5):
            others = [j for j in range(5) if j != k]
            weight = np.prod([(x - j) / (k - j) for j in others], axis=0)
            result += weight[:, None] * self.surface_k[block + k]
        return result


def solve(slabs: Sequence[Slab], forcing: Forcing, start_k: np.ndarray | float, tolerance_k: float = 0.05) -> History:
    """The history of ``slabs`` under ``forcing``, refined in depth and time until it changes by less than asked.

    **Convention:** nodes and steps are doubled and two levels at a time are extrapolated (Richardson; the method is of
    second order in both). ``error_k`` is the largest difference between the extrapolated and the finer level. It bounds
    the error of the former with much to spare: measured over a day of a yard, 8 mK where the error at the
    nodes is 0.6 mK (7 mK in the middle between them, where a cloud passes thin metal).

    Args:
        start_k: temperatures at the start, one for all or [m, nodes] evenly spaced in the graded index of depth.
        tolerance_k: the largest change in K that is allowed (``error_k``).

    Raises:
        RuntimeError: no convergence at the finest level.
    """
    coarse = integrate(slabs, forcing, start_k, cells=16, steps=4)
    for level in range(1, _LEVELS + 1):
        fine = integrate(slabs, forcing, start_k, cells=16 * 2**level, steps=4 * 2**level)
        surface = (4.0 * fine.surface_k[::2] - coarse.surface_k) / 3.0
        error = float(np.abs(fine.surface_k[::2] - surface).max())
        if error <= tolerance_k:
            return History(coarse.times_s, surface, fine.states_k, error)
        coarse = fine
    raise RuntimeError(f"outdoor heat did not converge: still changing by {error:.2g} K, tolerance {tolerance_k:.2g} K")


def integrate(slabs: Sequence[Slab], forcing: Forcing, start_k: np.ndarray | float, cells: int, steps: int) -> History:
    """The history on one grid: ``cells`` intervals in depth, ``steps`` steps (a multiple of four) between two samples."""
    grid = _Grid(slabs, cells)
    drivers, state, samples = grid.drivers(forcing), grid.start(start_k), forcing.times_s
    count = (len(samples) - 1) * steps + 1
    times, surfaces = np.empty(count), np.empty((count, len(slabs)))
    now = 0
    for piece in range(len(samples) - 1):
        step = (samples[piece + 1] - samples[piece]) / steps
        grid.factorise(step)
        first, last = drivers[piece], drivers[piece + 1]
        slope = _Drivers(*((b - a) / (steps * step) for a, b in zip(first, last, strict=True)))
        for inner in range(steps):
            passed = inner * step
            times[now], surfaces[now] = samples[piece] + passed, grid.surface(state)
            now += 1
            state = grid.advanced(state, first.after(slope, passed), slope, step)
    times[now], surfaces[now] = samples[-1], grid.surface(state)
    return History(times, surfaces, state.reshape(len(slabs), cells + 1))


class _Drivers(NamedTuple):
    """What drives surfaces at a moment, or its change per second."""

    flux: np.ndarray  # [m] that a surface takes up whatever its temperature
    h: np.ndarray  # [m] convection coefficient
    air_k: float

    def after(self, slope: _Drivers, seconds: float) -> _Drivers:
        return _Drivers(*(value + seconds * change for value, change in zip(self, slope, strict=True)))


class _Grid:
    """Slabs on ``cells`` intervals in depth, whose tridiagonal systems laid end to end form one tridiagonal system."""

    def __init__(self, slabs: Sequence[Slab], cells: int) -> None:
        def of_materials(key: str) -> np.ndarray:
            return np.array([getattr(slab.material, key) for slab in slabs])

        self.still, self.per_wind = of_materials("convection_still"), of_materials("convection_per_wind")
        self.emissivity = of_materials("emissivity")
        self.emitting = self.emissivity * STEFAN_BOLTZMANN
        self.absorptivity = np.array([slab.absorptivity for slab in slabs])
        self.face = np.array([slab.face for slab in slabs])
        self.nodes, self.count = cells + 1, len(slabs)
        x = np.linspace(0.0, 1.0, self.nodes) ** _DEPTH_GRADING * of_materials("depth_m")[:, None]
        gaps = np.diff(x)
        content = np.zeros((self.count, self.nodes))  # J/(m² K) of the volume about each node
        content[:, :-1] += 0.5 * gaps
        content[:, 1:] += 0.5 * gaps
        content *= of_materials("heat_capacity")[:, None]
        between = of_materials("conductivity")[:, None] / gaps
        none = np.zeros((self.count, 1))
        to_next, to_last = np.concatenate([between, none], axis=1), np.concatenate([none, between], axis=1)
        self.below = np.concatenate([between / content[:, 1:], none], axis=1).ravel()[:-1]
        self.above = np.concatenate([between / content[:, :-1], none], axis=1).ravel()[:-1]
        self.diagonal = (-(to_next + to_last) / content).ravel()
        self.share = 1.0 / content[:, 0]
        self.factorised_s: float | None = None

    def drivers(self, forcing: Forcing) -> list[_Drivers]:
        """Those at the samples of the forcing."""
        h = self.still + self.per_wind * forcing.wind_m_s[:, None]
        taken = self.absorptivity * forcing.sunlight_w_m2[:, self.face]
        flux = taken + self.emissivity * forcing.long_waves_w_m2[:, self.face]
        return [_Drivers(*values) for values in zip(flux, h, forcing.air_k, strict=True)]

    def start(self, start_k: np.ndarray | float) -> np.ndarray:
        """Temperatures of all nodes [m * nodes], one slab after the other; ``start_k`` is that of ``solve``."""
        start = np.asarray(start_k, dtype=np.float64)
        if start.ndim < 2:
            return np.full(self.count * self.nodes, start)
        old, new = np.linspace(0.0, 1.0, start.shape[1]), np.linspace(0.0, 1.0, self.nodes)
        return np.concatenate([np.interp(new, old, values) for values in start])

    def surface(self, state: np.ndarray) -> np.ndarray:
        """Temperatures of the surfaces [m], a view."""
        return state[:: self.nodes]

    def factorise(self, step: float) -> None:
        """Prepares steps of so many seconds."""
        if step == self.factorised_s:
            return
        weight = _GAMMA * step
        *self._factors, failed = dgttrf(-weight * self.below, 1.0 - weight * self.diagonal, -weight * self.above)
        if failed:
            raise RuntimeError(f"outdoor heat: singular step of {step:g} s")
        unit = np.zeros(self.diagonal.size)
        self.surface(unit)[:] = 1.0
        self._influence, self.factorised_s = dgttrs(*self._factors, unit)[0], step

    def rate(self, state: np.ndarray, drivers: _Drivers) -> np.ndarray:
        """K/s of all nodes."""
        change = self.diagonal * state
        change[1:] += self.below * state[:-1]
        change[:-1] += self.above * state[1:]
        surface = self.surface(state)
        taken = drivers.flux + drivers.h * (drivers.air_k - surface) - self.emitting * surface**4
        self.surface(change)[:] += self.share * taken
        return change

    def advanced(self, state: np.ndarray, drivers: _Drivers, slope: _Drivers, step: float) -> np.ndarray:
        """The state a step later, by ROS2; steps as factorised."""
        weight, surface = _GAMMA * step, self.surface(state)
        # Of the matrix only the surface's own entry changes from step to step: Sherman and Morrison's formula.
        own = weight * self.share * (drivers.h + 4.0 * self.emitting * surface**3)
        own /= 1.0 + own * self.surface(self._influence)
        drift = slope.flux + slope.h * (drivers.air_k - surface) + drivers.h * slope.air_k
        drift *= weight * self.share
        change = self.rate(state, drivers)
        self.surface(change)[:] += drift
        first = self._solved(change, own)
        ahead = self.rate(state + step * first, drivers.after(slope, step))
        ahead -= 2.0 * first
        self.surface(ahead)[:] -= drift
        return state + step * (1.5 * first + 0.5 * self._solved(ahead, own))

    def _solved(self, right: np.ndarray, own: np.ndarray) -> np.ndarray:
        found = dgttrs(*self._factors, right)[0]
        found -= np.repeat(own * self.surface(found), self.nodes) * self._influence
        return found
