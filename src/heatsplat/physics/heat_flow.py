"""How fast a small body warms in sun and air, and what balance of heat says of its temperature over an interval.

V c dT/dt = α A_⊥ G - e σ A_rad (T⁴ - T_sky⁴) - h A_surf (T - T_air) (ThermoGS, Eq. 2-5), with areas over volumes
(``heatsplat.physics.ellipsoids``), so that no volume is ever formed.

**Convention:** kelvin, seconds, metres, watts; any shapes that broadcast.
"""

from __future__ import annotations

from torch import Tensor

from heatsplat.physics.units import STEFAN_BOLTZMANN


def fourth_powers(warm_k: Tensor, cold_k: Tensor | float) -> Tensor:
    """T⁴ - S⁴ in K⁴, factored: of 300.0 and 299.9 K in float32 the plain difference has lost four digits."""
    return (warm_k - cold_k) * (warm_k + cold_k) * (warm_k * warm_k + cold_k * cold_k)


def heating_rate(
    temperatures_k: Tensor,
    *,
    absorbed_w_m3: Tensor | float,
    emissivity: Tensor,
    convection: Tensor,
    capacity: Tensor,
    radiating_ratio: Tensor,
    convecting_ratio: Tensor,
    air_k: float,
    sky_k: float = 0.0,
) -> Tensor:
    """dT/dt in K/s.

    Args:
        temperatures_k: T.
        absorbed_w_m3: sunlight taken in, α A_⊥/V G.
        emissivity: e.
        convection: h in W/(m² K).
        capacity: c in J/(m³ K), positive.
        radiating_ratio, convecting_ratio: A_rad/V and A_surf/V in 1/m.
        air_k: temperature of the air.
        sky_k: temperature of what the body sees in the thermal band; 0 leaves its radiation out, as the paper does.
    """
    radiated = emissivity * radiating_ratio * (STEFAN_BOLTZMANN * fourth_powers(temperatures_k, sky_k))
    convected = convection * convecting_ratio * (temperatures_k - air_k)
    return (absorbed_w_m3 - radiated - convected) / capacity
