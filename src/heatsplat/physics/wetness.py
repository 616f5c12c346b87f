"""Water on surfaces under the sky: how wet rain leaves them, and what evaporation takes.

Water on a surface evaporates as its heat is carried off (Lewis 1922): a flux of sensible heat h (T - T_air) comes with one of
latent heat h L (ρ_sat(T) - ρ_v), with vapour densities and L = Λ / (ρ c) of air. A film of water dries by that at the surface's
own temperature (``march`` in heatsplat.kernels.heat_balance, which has it from ``vapour_k`` and ``drying_mm_s_k``).

Where one exchange has to do for all surfaces, as in fits of many of them, the film dries as one as warm as the air does
(``wet_share``), and over the few kelvin between the air and the wet bulb ρ_sat is a straight line that is exact at both, so that
a surface of which a share w is wet exchanges

    h (1 + w s) (T_eq - T),    T_eq = T_air - w d / (1 + w s),    d = L (ρ_sat(T_air) - ρ_v),

with s the slope of L ρ_sat. It follows an air of T_eq, that of the wet bulb where all is wet, 1 + w s times as fast. Nothing
of this is learned.

**Convention:** kelvin, seconds, kg of water a square metre, which are millimetres; [T] float64 on the record's times.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from heatsplat.contracts import Weather
from heatsplat.kernels.heat_balance import AIR_J_M3_K, COVERS_MM, LATENT_J_KG, VAPOUR_J_KG_K
from heatsplat.physics.sky import vapour_pressure_hpa
from heatsplat.physics.units import kelvin
from heatsplat.physics.walls import CONVECTION

FILM_MM = 0.3  # that stays on a surface where nobody says otherwise; the rest runs off
PIECE_S = 60.0  # of a step between samples, over which evaporation is even
BISECTIONS, COLDEST_K = 40, 60.0  # below the air, from which the wet bulb is sought


def vapour_kg_m3(air_k: Tensor, humidity_percent: Tensor | float = 100.0) -> Tensor:
    """Density of water vapour in air of a relative humidity, of any shape; of saturated air by default."""
    hpa = vapour_pressure_hpa(air_k, torch.as_tensor(humidity_percent, dtype=air_k.dtype))
    return 100.0 * hpa / (VAPOUR_J_KG_K * air_k)


def vapour_k(air_k: Tensor, humidity_percent: Tensor) -> Tensor:
    """L ρ_v of air of a relative humidity in kelvin, of any shape: what it lacks to that of a wet surface cools the surface."""
    return LATENT_J_KG / AIR_J_M3_K * vapour_kg_m3(air_k, humidity_percent)


def drying_mm_s_k(weather: Weather) -> Tensor:
    """What a wet surface evaporates in mm/(s K) for each kelvin of L ρ_v that the air lacks, [T], under convection by convention
    (ISO 6946, annex C)."""
    wind = torch.zeros_like(weather.times_s) if weather.wind_m_s is None else weather.wind_m_s
    return (CONVECTION[0] + CONVECTION[1] * wind) / LATENT_J_KG


def wet_bulb_k(air_k: Tensor, humidity_percent: Tensor) -> Tensor:
    """Temperature of a surface that is wet all over and exchanges heat with the air alone, of any shape (Lewis 1922)."""
    vapour, high = vapour_kg_m3(air_k, humidity_percent), air_k
    low = air_k - COLDEST_K
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        warm = middle + LATENT_J_KG / AIR_J_M3_K * (vapour_kg_m3(middle) - vapour) > air_k
        low, high = torch.where(warm, low, middle), torch.where(warm, middle, high)
    return 0.5 * (low + high)


def wet_share(
    times_s: Tensor, rain_mm_h: Tensor, air_k: Tensor, humidity_percent: Tensor, wind_m_s: Tensor | None, film_mm: float
) -> Tensor:
    """Share of level surfaces that rain has left wet, in [0, 1]; dry at the first sample.

    The film takes up rain until it holds ``film_mm``, and dries as a surface as warm as the air does under convection by
    convention (ISO 6946, annex C); one thinner than COVERS_MM covers part of the surface.
    """
    wind = torch.zeros_like(air_k) if wind_m_s is None else wind_m_s
    lacking = (vapour_kg_m3(air_k) - vapour_kg_m3(air_k, humidity_percent)).clamp(min=0.0)
    dries = (CONVECTION[0] + CONVECTION[1] * wind) / AIR_J_M3_K * lacking  # kg/(m² s) of a surface that is wet all over
    film, found = 0.0, [0.0]
    steps, rain, dries = times_s.diff().tolist(), (rain_mm_h / 3600.0).tolist(), dries.tolist()
    for k, step in enumerate(steps):
        if film == 0.0 and rain[k] == 0.0 == rain[k + 1]:
            found.append(0.0)
            continue
        pieces = max(1, round(step / PIECE_S))
        for piece in range(pieces):
            part = (piece + 0.5) / pieces
            falls = rain[k] + part * (rain[k + 1] - rain[k])
            leaves = dries[k] + part * (dries[k + 1] - dries[k])
            film, left = min(film + step / pieces * falls, film_mm), step / pieces
            if film > COVERS_MM:
                even = min((film - COVERS_MM) / leaves if leaves > 0 else math.inf, left)
                film, left = film - even * leaves, left - even
            film *= math.exp(-left * leaves / COVERS_MM)
        # A trace is dry once the rain is over; while it rains, what has fallen since the last sample may be no more than that.
        film = film if film > 1e-3 * COVERS_MM or rain[k + 1] > 0.0 else 0.0
        found.append(min(film / COVERS_MM, 1.0))
    return torch.tensor(found, dtype=torch.float64)


def rained_on(weather: Weather, film_mm: float) -> Tensor | None:
    """``wet_share`` [T] of a record; None where it tells no rain, or not how moist or warm the air is."""
    if weather.rain_mm_h is None or weather.humidity_percent is None or weather.air_c is None:
        return None
    air_k = kelvin(weather.air_c)
    return wet_share(weather.times_s, weather.rain_mm_h, air_k, weather.humidity_percent, weather.wind_m_s, film_mm)


def wetted(air_k: Tensor, humidity_percent: Tensor, wet: Tensor) -> tuple[Tensor, Tensor]:
    """Temperature T_eq of the air that a surface finds of which a share ``wet`` in [0, 1] is wet, and how many times as fast it
    exchanges heat, 1 + w s; of any shape."""
    gain = LATENT_J_KG / AIR_J_M3_K
    bulb = wet_bulb_k(air_k, humidity_percent)
    lacks = gain * (vapour_kg_m3(air_k) - vapour_kg_m3(air_k, humidity_percent))
    below = (air_k - bulb).clamp(min=1e-3)  # in saturated air the chord is the tangent
    slope = gain * (vapour_kg_m3(air_k) - vapour_kg_m3(air_k - below)) / below
    times = 1.0 + wet * slope
    return air_k - wet * lacks / times, times
