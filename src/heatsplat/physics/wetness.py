"""Water on surfaces under the sky: what evaporation takes.

Water on a surface evaporates as its heat is carried off (Lewis 1922): a flux of sensible heat h (T - T_air) comes with one of
latent heat h L (ρ_sat(T) - ρ_v), with vapour densities and L = Λ / (ρ c) of air. A film of water dries by that at the surface's
own temperature: ``march`` in heatsplat.kernels.marching has what air holds from ``vapour_k`` and ``drying_mm_s_k``.

**Convention:** kelvin, seconds, kg of water a square metre, which are millimetres; [T] float64 on the record's times.
"""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.contracts import Weather
from heatsplat.kernels.heat_balance import AIR_J_M3_K, LATENT_J_KG, VAPOUR_J_KG_K
from heatsplat.physics.sky import vapour_pressure_hpa
from heatsplat.physics.walls import CONVECTION

FILM_MM = 0.3  # that stays on a surface where nobody says otherwise; the rest runs off


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
