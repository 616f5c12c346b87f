"""What the parts of a weather record drive surfaces by: fields of ``Drivers`` by name, for a balance in training and for one that
is fitted to points alike.

**Convention:** that of heatsplat.physics.surfaces: kelvin above a reference temperature, kW/m², seconds; [T] float64.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from heatsplat.contracts import Weather
from heatsplat.physics.surfaces import power_excess
from heatsplat.physics.units import kelvin
from heatsplat.physics.wetness import drying_mm_s_k, vapour_k


def of_sunlight(weather: Weather, tilted: bool) -> dict[str, Tensor]:
    """``up``, ``beams`` of the sun, and ``light`` of the sky; where the record lacks one of them, the irradiance on level ground
    as ``light``, or nothing without one.

    Args:
        tilted: whether it is known how surfaces lie; if not, all count as level.
    """
    if tilted and None not in (weather.sun, weather.direct_w_m2, weather.diffuse_w_m2):
        return {
            "up": weather.up.double(),
            "light": weather.diffuse_w_m2 / 1000.0,
            "beams": weather.direct_w_m2[:, None] * weather.sun / 1000.0,
        }
    return {} if weather.irradiance_w_m2 is None else {"light": weather.irradiance_w_m2 / 1000.0}


def of_sky(weather: Weather, sky_k: Tensor, reference_k: float, tilted: bool) -> dict[str, Tensor]:
    """``sky`` of its temperature [T] in kelvin; ``around`` of the air's, which surfaces that lean see in its place."""
    drivers = {"sky": power_excess(sky_k - reference_k, reference_k)}
    if tilted:
        drivers["around"] = power_excess(kelvin(weather.air_c) - reference_k, reference_k)
    return drivers


def of_water(weather: Weather, holds_mm: float | None, transpires: bool) -> dict[str, Any]:
    """``rain``, ``dries`` and ``holds_mm`` where rain wets surfaces, and ``vapour`` where anything evaporates.

    Args:
        holds_mm: of the record's rain that stay on surfaces; None: they stay dry.
        transpires: whether dry surfaces evaporate, too.
    """
    drivers: dict[str, Any] = {}
    if holds_mm is not None:
        drivers = {"rain": weather.rain_mm_h / 3600.0, "dries": drying_mm_s_k(weather), "holds_mm": holds_mm}
    if holds_mm is not None or transpires:
        drivers["vapour"] = vapour_k(kelvin(weather.air_c), weather.humidity_percent)
    return drivers
