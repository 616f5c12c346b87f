"""Heat of bodies in layers under the sky: conduction through all layers, and a surface that rain and dew wet.

    ρc ∂T/∂t = ∂/∂x (k ∂T/∂x) within,    -k ∂T/∂x = q at x = 0,    -k ∂T/∂x = h_b (T - T_b) at the back,
    q = α G + ε (L - σ T⁴) + h (T_air - T) - Λ E,    E = h / (ρ_a c_a) · wet · (ρ_v,sat(T) - ρ_v) (Lewis).

Finite volumes in depth, in the eigenvectors of each body's conduction: every mode decays on its own and takes up a q that is
linear over a step, exactly. What is left is one equation for the surface's temperature at the end of the step, whose T⁴ and
saturated vapour Newton's method solves. Nothing is linearised about a mean, and nothing of ``heatsplat.physics`` is used but
constants, which makes this an independent check of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from heatsplat.physics.units import KELVIN_AT_0_C, STEFAN_BOLTZMANN

EVAPORATION_J_KG = 2.45e6
AIR_J_M3_K = 1.2e3  # ρ c of air
VAPOUR_J_KG_K = 461.5
WET_KG_M2 = 0.1  # a film thinner than this covers only part of the surface
NODES_A_LAYER = 7
GRADING = 1.6  # of the nodes of a body's first layer; a day's wave is steepest at the surface
NEWTON_STEPS = 3  # change by 1e-6 K in the last, at steps of 5 minutes


@dataclass(frozen=True)
class Layer:
    """Conductivity in W/(m K), volumetric heat capacity in J/(m³ K) and thickness in m."""

    conductivity: float
    heat_capacity: float
    thickness_m: float


@dataclass(frozen=True)
class Body:
    """What a surface under the sky belongs to.

    Args:
        layers: from the surface inwards.
        emissivity: of long waves, in [0, 1].
        convection_still: h without wind, in W/(m² K).
        convection_per_wind: what a metre per second of wind adds to it, in W s/(m³ K).
        back_c: temperature behind the last layer in °C, such as that of a heated room or of the deep ground.
        back_w_m2_k: h_b of the exchange with it; 0 insulates.
        holds_kg_m2: water that stays on the surface; more runs off.
        transpires: share of a wet surface's evaporation that a dry one has, such as grass.
    """

    layers: tuple[Layer, ...]
    emissivity: float
    convection_still: float
    convection_per_wind: float
    back_c: float = 12.0
    back_w_m2_k: float = 0.0
    holds_kg_m2: float = 0.3
    transpires: float = 0.0


@dataclass(frozen=True)
class Sky:
    """What drives surfaces, at times [T]; everything is linear in between.

    Args:
        times_s: increasing, evenly spaced.
        air_k, wind_m_s: [T].
        vapour_kg_m3: [T] density of water vapour in the air.
        rain_kg_m2_s: [T].
        long_waves_w_m2: [T] of the whole sky on a level surface.
    """

    times_s: np.ndarray
    air_k: np.ndarray
    wind_m_s: np.ndarray
    vapour_kg_m3: np.ndarray
    rain_kg_m2_s: np.ndarray
    long_waves_w_m2: np.ndarray


@dataclass(frozen=True)
class Patches:
    """P pieces of surface.

    Args:
        body: [P] number of the body.
        absorptivity: [P].
        sky_share: [P] share of the long waves that reach it which come from the sky.
        sunlight_w_m2: [T, P] irradiance on each.
        ground: [P] bool, the patches whose mean temperature is what all others see below the horizon; None: air.
    """

    body: np.ndarray
    absorptivity: np.ndarray
    sky_share: np.ndarray
    sunlight_w_m2: np.ndarray
    ground: np.ndarray | None = None


@dataclass(frozen=True)
class Course:
    """Surface temperatures over time.

    Args:
        times_s: [n] ends of the steps, evenly spaced, the start first.
        surface_k: [n, P] float32.
        modes: [P, J] the state at the end, from which another course may go on.
        film_kg_m2: [P] water at the end.
    """

    times_s: np.ndarray
    surface_k: np.ndarray
    modes: np.ndarray
    film_kg_m2: np.ndarray

    def at(self, time_s: float) -> np.ndarray:
        """[P] in kelvin, linear between steps. Raises ValueError outside of the record."""
        if not self.times_s[0] - 1e-6 <= time_s <= self.times_s[-1] + 1e-6:
            raise ValueError(
                f"heat is solved for {self.times_s[0]:g} .. {self.times_s[-1]:g} s; asked for {time_s:g} s"
            )
        place = (time_s - self.times_s[0]) / (self.times_s[1] - self.times_s[0])
        before = int(np.clip(place, 0, len(self.times_s) - 2))
        return self.surface_k[before] + (place - before) * (self.surface_k[before + 1] - self.surface_k[before])


def saturated_kg_m3(kelvin: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Density of saturated water vapour, and its slope per kelvin (Magnus; Alduchov and Eskridge 1996)."""
    celsius = kelvin - KELVIN_AT_0_C
    density = 610.94 * np.exp(17.625 * celsius / (celsius + 243.04)) / (VAPOUR_J_KG_K * kelvin)
    return density, density * (17.625 * 243.04 / (celsius + 243.04) ** 2 - 1.0 / kelvin)


def volumes(body: Body, nodes: int = NODES_A_LAYER) -> tuple[np.ndarray, np.ndarray]:
    """Heat capacities [n] in J/(m² K) of the volumes about the nodes of a body, the surface first, and conductances
    [n - 1] between them in W/(m² K)."""
    content, between = [0.0], []
    for number, layer in enumerate(body.layers):
        grading = GRADING if number == 0 else 1.0
        gaps = np.diff(np.linspace(0.0, 1.0, nodes + 1) ** grading) * layer.thickness_m
        for gap in gaps:
            content[-1] += 0.5 * gap * layer.heat_capacity
            content.append(0.5 * gap * layer.heat_capacity)
            between.append(layer.conductivity / gap)
    return np.array(content), np.array(between)


@dataclass(frozen=True)
class _Modes:
    """Eigenvectors of the bodies' conduction, padded with modes that never stir; [B, J] each.

    Args:
        rates: in 1/s.
        surface: what a mode adds to the surface's temperature, and takes of q.
        back: what it takes of h_b T_b.
        even: the modes of 1 K throughout.
    """

    rates: np.ndarray
    surface: np.ndarray
    back: np.ndarray
    even: np.ndarray

    @classmethod
    def of(cls, bodies: Sequence[Body], nodes: int) -> _Modes:
        found = []
        for body in bodies:
            content, between = volumes(body, nodes)
            conduction = np.diag(np.append(between, body.back_w_m2_k)) + np.diag(np.append(0.0, between))
            conduction -= np.diag(between, 1) + np.diag(between, -1)
            root = np.sqrt(content)
            rates, vectors = np.linalg.eigh(conduction / root[:, None] / root)
            driven = body.back_w_m2_k * (body.back_c + KELVIN_AT_0_C)
            found.append((rates, vectors[0] / root[0], vectors[-1] / root[-1] * driven, root @ vectors))
        most = max(len(rates) for rates, *_ in found)
        return cls(
            *(np.stack([np.pad(row, (0, most - len(row))) for row in rows]) for rows in zip(*found, strict=True))
        )


@dataclass(frozen=True)
class _Exchange:
    """What surfaces exchange at a moment, as far as it depends on their temperature; [P] each, or one number.

    Args:
        given: what does not depend on it, in W/m².
        h: of convection, in W/(m² K).
        emitting: ε σ.
        wet: share of the evaporation of water, in [0, 1].
        vapour: density in the air, in kg/m³.
    """

    given: np.ndarray
    h: np.ndarray
    emitting: np.ndarray
    wet: np.ndarray
    vapour: float

    def at(self, kelvin: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """q, its slope, and E."""
        density, steep = saturated_kg_m3(kelvin)
        moist = self.h / AIR_J_M3_K * np.where(density > self.vapour, self.wet, 1.0)  # dew falls on dry surfaces too
        evaporated = moist * (density - self.vapour)
        q = self.given - self.h * kelvin - self.emitting * kelvin**4 - EVAPORATION_J_KG * evaporated
        return q, -self.h - 4.0 * self.emitting * kelvin**3 - EVAPORATION_J_KG * moist * steep, evaporated


def solve(
    bodies: Sequence[Body],
    patches: Patches,
    sky: Sky,
    start: Course | float,
    step_s: float = 300.0,
    nodes: int = NODES_A_LAYER,
) -> Course:
    """The course of P patches under a sky.

    Args:
        start: temperature throughout in kelvin, or the course that they go on from.
        step_s: of the solver; a whole number of them makes a sample of the sky.
        nodes: volumes of a layer.
    """
    modes = _Modes.of(bodies, nodes)
    rates, surface, back, even = (table[patches.body] for table in (modes.rates, modes.surface, modes.back, modes.even))
    y = np.maximum(rates, 0.0) * step_s
    small = y < 1e-4
    safe = np.where(small, 1.0, y)
    first = np.where(small, 1.0 - 0.5 * y, -np.expm1(-safe) / safe)
    second = np.where(small, 0.5 - y / 6.0, (1.0 - first) / safe)
    decay, driven = np.exp(-y), step_s * first * back
    of_start, of_end = step_s * (first - second) * surface, step_s * second * surface
    at_once = (surface * of_end).sum(1)

    def per_patch(name: str) -> np.ndarray:
        return np.array([getattr(body, name) for body in bodies])[patches.body]

    emissivity, still, per_wind = (per_patch(n) for n in ("emissivity", "convection_still", "convection_per_wind"))
    transpires, holds = per_patch("transpires"), per_patch("holds_kg_m2")
    emitting = emissivity * STEFAN_BOLTZMANN
    if isinstance(start, Course):
        state, film = start.modes.copy(), start.film_kg_m2.copy()
    else:
        state, film = start * even, np.zeros(len(emissivity))
    drivers = sky.air_k, sky.wind_m_s, sky.vapour_kg_m3, sky.rain_kg_m2_s, sky.long_waves_w_m2, patches.sunlight_w_m2
    times = np.arange(sky.times_s[0], sky.times_s[-1] + 0.5 * step_s, step_s)
    course = np.empty((len(times), len(emissivity)), dtype=np.float32)
    now = (state * surface).sum(1)
    course[0] = now
    taken: np.ndarray | None = None
    for number, time in enumerate(times):
        place = (time - sky.times_s[0]) / (sky.times_s[1] - sky.times_s[0])
        k = min(int(place), len(sky.times_s) - 2)
        share = place - k
        air, wind, vapour, rain, of_sky, light = (series[k] + share * (series[k + 1] - series[k]) for series in drivers)
        h = still + per_wind * wind
        below = air if patches.ground is None else now[patches.ground].mean()
        waves = patches.sky_share * of_sky + (1 - patches.sky_share) * STEFAN_BOLTZMANN * below**4
        given = patches.absorptivity * light + emissivity * waves + h * air
        wet = np.minimum(film / WET_KG_M2, 1.0)
        exchange = _Exchange(given, h, emitting, wet + (1.0 - wet) * transpires, vapour)
        if taken is not None:
            known = decay * state + of_start * taken[:, None] + driven
            without = (known * surface).sum(1)
            for _ in range(NEWTON_STEPS):
                q, slope, _ = exchange.at(now)
                now = now - (now - without - at_once * q) / (1.0 - at_once * slope)
            q, _, evaporated = exchange.at(now)
            state = known + of_end * q[:, None]
            course[number] = now = (state * surface).sum(1)
            dry = np.where(evaporated > 0, evaporated * (1.0 - transpires), evaporated)
            film = np.clip(film + step_s * (rain - dry), 0.0, holds)
        taken = exchange.at(now)[0]
    return Course(times, course, state, film)
