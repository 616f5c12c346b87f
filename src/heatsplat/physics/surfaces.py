"""Surfaces under the sky and what drives them; heatsplat.physics.energy_balance says what the symbols mean.

**Convention:** kelvin above a reference temperature R, kW/m², seconds.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor


class Core(NamedTuple):
    """What lies behind the surfaces of n bodies of two nodes, each [n]; see the module.

    Args:
        start: y at the first sample of the record, in kelvin above the reference.
        log_rate: log μ, μ in 1/s.
        coupling: κ, positive.
    """

    start: Tensor
    log_rate: Tensor
    coupling: Tensor


class Exposure(NamedTuple):
    """What the scene leaves n surfaces of sun and sky.

    Args:
        sun: [n, D] share of the beam from the directions of ``Drivers.ways``, or None: nothing casts shadows.
        sky: [n] share of the sky's light, of what surfaces turned like these get without obstacles, or None: all of it.
    """

    sun: Tensor | None = None
    sky: Tensor | None = None


class Surface(NamedTuple):
    """What decides the temperature of n surfaces, each [n]; see the module for the symbols.

    Args:
        start: x at the first sample of the record, in kelvin above the reference.
        log_rate: log r, r in 1/s.
        sun: g in K m²/kW, at least 0, or None where nothing is lit.
        share: p, or None where nothing radiates.
        wind: v, or None where wind is not known.
        normals: [n, 3] unit vectors, or None for surfaces that lie level.
        core: what lies behind, or None for bodies of one node.
        inner: f in kelvin (at x = 0 where there is a room), or None where nothing is heated from within.
        exposure: what hides sun and sky from surfaces with normals.
        transpires: q, share in [0, 1] of a wet surface's evaporation that it has where it is dry, or None: it has none.
        film: mm of water on it at the first sample, or None: it is dry.
    """

    start: Tensor
    log_rate: Tensor
    sun: Tensor | None
    share: Tensor | None = None
    wind: Tensor | None = None
    normals: Tensor | None = None
    core: Core | None = None
    inner: Tensor | None = None
    exposure: Exposure = Exposure()
    transpires: Tensor | None = None
    film: Tensor | None = None


@dataclass(frozen=True)
class Drivers:
    """A weather record as what drives surfaces, [T] float64 each, in kelvin above the reference and kW/m².

    Args:
        times_s: increasing.
        reference_k: R.
        air: temperature of the air.
        sky: s of the sky, or None where nothing radiates.
        around: s of what a tilted surface sees instead of sky, or None where all lie level.
        light: sunlight on a level surface without that of ``beams``, or None.
        beams: [T, 3] direction towards the sun times its strength, or None.
        wind_anomaly: wind / mean wind - 1, or None.
        up: [3], or None where all surfaces lie level.
        ground: light that comes back from level ground, or None where it is black.
        ways: [D, 3] directions of the sun for which shadows are known, or None.
        room: ρ of the air behind walls, not 0, or None: heat from within is constant.
        vapour: L ρ_v of the air in kelvin (heatsplat.physics.wetness), or None: nothing evaporates. Only the full balance
            knows it, and what follows.
        rain: mm/s, or None: no rain wets surfaces.
        dries: what a wet surface evaporates in mm/(s K), where there is rain.
        holds_mm: of rain that stay on surfaces.
    """

    times_s: Tensor
    reference_k: float
    air: Tensor
    sky: Tensor | None = None
    around: Tensor | None = None
    light: Tensor | None = None
    beams: Tensor | None = None
    wind_anomaly: Tensor | None = None
    up: Tensor | None = None
    ground: Tensor | None = None
    ways: Tensor | None = None
    room: float | None = None
    vapour: Tensor | None = None
    rain: Tensor | None = None
    dries: Tensor | None = None
    holds_mm: float = 0.0


def power_excess(excess_k: Tensor, reference_k: float) -> Tensor:
    """w = (T⁴ - R⁴) / (4 R³) of T = R + x: what a body radiates more than at R, in kelvin; factored, so nothing cancels."""
    z = excess_k / reference_k
    return excess_k * (1 + z * (1.5 + z * (1 + 0.25 * z)))
