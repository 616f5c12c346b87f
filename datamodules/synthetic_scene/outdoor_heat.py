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
    """The history on one grid: ``cells`` intervals in depth, ``steps`` steps (a multiple of four) between two samples.

    All slabs are advanced at once: their tridiagonal systems laid end to end form one tridiagonal system.
    """
    k, capacity, depth, emissivity, still, per_wind = (
        np.array([getattr(slab.material, key) for slab in slabs])
        for key in (
            "conductivity",
            "heat_capacity",
            "depth_m",
            "emissivity",
            "convection_still",
            "convection_per_wind",
        )
    )
    absorptivity = np.array([slab.absorptivity for slab in slabs])
    face = np.array([slab.face for slab in slabs])
    nodes = cells + 1
    x = np.linspace(0.0, 1.0, nodes) ** _DEPTH_GRADING * depth[:, None]
    gaps = np.diff(x)
    content = np.zeros((len(slabs), nodes))  # J/(m² K) of the volume about each node
    content[:, :-1] += 0.5 * gaps
    content[:, 1:] += 0.5 * gaps
    content *= capacity[:, None]
    between = k[:, None] / gaps
    none = np.zeros((len(slabs), 1))
    below = np.concatenate([between / content[:, 1:], none], axis=1).ravel()[:-1]
    above = np.concatenate([between / content[:, :-1], none], axis=1).ravel()[:-1]
    diagonal = (-(np.concatenate([between, none], axis=1) + np.concatenate([none, between], axis=1)) / content).ravel()
    share = 1.0 / content[:, 0]

    # Drivers of the surface: constant part of the flux, its convection coefficient, both at the samples of the forcing.
    exchange = still + per_wind * forcing.wind_m_s[:, None]
    incoming = absorptivity * forcing.sunlight_w_m2[:, face] + emissivity * forcing.long_waves_w_m2[:, face]
    emitting = emissivity * STEFAN_BOLTZMANN

    def rate(state: np.ndarray, flux: np.ndarray, h: np.ndarray, air: float) -> np.ndarray:
        change = diagonal * state
        change[1:] += below * state[:-1]
        change[:-1] += above * state[1:]
        surface = state[::nodes]
        change[::nodes] += share * (flux + h * (air - surface) - emitting * surface**4)
        return change

    state = np.empty((len(slabs), nodes))
    start = np.asarray(start_k, dtype=np.float64)
    if start.ndim == 2:
        old = np.linspace(0.0, 1.0, start.shape[1])
        for row, values in zip(state, start, strict=True):
            row[:] = np.interp(np.linspace(0.0, 1.0, nodes), old, values)
    else:
        state[:] = start
    state = state.ravel()

    samples = forcing.times_s
    count = (len(samples) - 1) * steps + 1
    times, surfaces = np.empty(count), np.empty((count, len(slabs)))
    now, step_of_factors = 0, None
    for piece in range(len(samples) - 1):
        step = (samples[piece + 1] - samples[piece]) / steps
        flux_slope = (incoming[piece + 1] - incoming[piece]) / (steps * step)
        h_slope = (exchange[piece + 1] - exchange[piece]) / (steps * step)
        air_slope = (forcing.air_k[piece + 1] - forcing.air_k[piece]) / (steps * step)
        weight = _GAMMA * step
        if step != step_of_factors:
            *factors, failed = dgttrf(-weight * below, 1.0 - weight * diagonal, -weight * above)
            if failed:
                raise RuntimeError(f"outdoor heat: singular step of {step:g} s")
            unit = np.zeros(state.size)
            unit[::nodes] = 1.0
            influence, step_of_factors = dgttrs(*factors, unit)[0], step
        for inner in range(steps):
            passed = inner * step
            flux, h = incoming[piece] + passed * flux_slope, exchange[piece] + passed * h_slope
            air = forcing.air_k[piece] + passed * air_slope
            change = rate(state, flux, h, air)
            surface = state[::nodes]
            times[now], surfaces[now] = samples[piece] + passed, surface
            now += 1
            # Of the matrix only the surface's own entry changes from step to step: Sherman and Morrison's formula.
            own = weight * share * (h + 4.0 * emitting * surface**3)
            own /= 1.0 + own * influence[::nodes]
            drift = weight * share * (flux_slope + h_slope * (air - surface) + h * air_slope)
            change[::nodes] += drift
            first = dgttrs(*factors, change)[0]
            first -= np.repeat(own * first[::nodes], nodes) * influence
            ahead = rate(state + step * first, flux + step * flux_slope, h + step * h_slope, air + step * air_slope)
            ahead -= 2.0 * first
            ahead[::nodes] -= drift
            second = dgttrs(*factors, ahead)[0]
            second -= np.repeat(own * second[::nodes], nodes) * influence
            state = state + step * (1.5 * first + 0.5 * second)
    times[now], surfaces[now] = samples[-1], state[::nodes]
    return History(times, surfaces, state.reshape(len(slabs), nodes))
