"""Temperature of the sky in the thermal band: how cold a surface finds it, from what a weather station measures.

**Convention:** kelvin; the sky's long waves are those of a black body at this temperature, σ T_sky⁴.
"""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.contracts import check_option
from heatsplat.physics.units import celsius

DIFFUSIVITY = 1.66  # slants of the whole hemisphere count as this one (Elsasser 1942)
# Stations round to whole per cent. A reading of 0 would be air without vapour, whose sky is at 0 K by Brutsaert's law; air near
# the ground has hardly ever less than this.
DRIEST_PERCENT = 1.0
# Vertex of Berdahl and Martin's parabola, which was fitted above it and rises again below, up to that of a black body.
LOWEST_DEW_C = -0.0056 / (2 * 0.000073)
LOWEST_SINE = 0.02  # of the height above the horizon; below, air is seen as far as it goes
LAWS = ("brutsaert", "berdahl_martin", "brunt", "swinbank")


def law_for(law: str, humid: bool) -> str:
    """The law itself; for "auto" Brutsaert's where the humidity is known and Swinbank's where it is not."""
    if law == "auto":
        return "brutsaert" if humid else "swinbank"
    return law


def vapour_pressure_hpa(air_k: Tensor, humidity_percent: Tensor) -> Tensor:
    """Pressure of water vapour in hPa, by Magnus' formula (Alduchov and Eskridge 1996, Eq. 21)."""
    air_c = celsius(air_k)
    return humidity_percent / 100 * 6.1094 * (17.625 * air_c / (air_c + 243.04)).exp()


def dew_point_c(vapour_hpa: Tensor) -> Tensor:
    """Dew point in °C of a vapour pressure: the inverse of Magnus' formula."""
    log = (vapour_hpa.clamp(min=1e-6) / 6.1094).log()
    return 243.04 * log / (17.625 - log)


def sky_temperature_k(air_k: Tensor, humidity_percent: Tensor | None, law: str, clouds: Tensor | float = 0.0) -> Tensor:
    """Temperature of the sky in kelvin, of any shape.

    Args:
        air_k: near the ground.
        humidity_percent: relative; needed by all laws but Swinbank's. Less than 1 % counts as 1 %.
        law: "brutsaert" (1975): emissivity 1.24 (e/T)^(1/7); "brunt" (1932, coefficients of Sellers 1965): 0.605 +
            0.048 √e; "berdahl_martin" (1984, without the hour of the day): 0.711 + 0.0056 d + 0.000073 d² with the dew
            point d in °C, at least -38.4 (the vertex); "swinbank" (1963): T_sky = 0.0552 T^1.5, from air temperature
            alone. All are of clear skies.
        clouds: share of the clear sky's light that clouds take, in [0, 1]: as much of the sky is a black body of the air's
            temperature (Crawford and Duchon 1999, Eq. 5 and 20).

    Raises:
        ValueError: the law is unknown, or lacks the humidity.
    """
    check_option("law of the sky", law, LAWS)
    clear = _clear_emissivity(air_k, humidity_percent, law)
    return air_k * (clear + clouds * (1.0 - clear)) ** 0.25


def _clear_emissivity(air_k: Tensor, humidity_percent: Tensor | None, law: str) -> Tensor:
    if law == "swinbank":
        return (0.0552 * air_k**0.5).clamp(max=1.0) ** 4
    if humidity_percent is None:
        raise ValueError(f"law of the sky '{law}' needs the humidity; without it there is swinbank")
    vapour = vapour_pressure_hpa(air_k, humidity_percent.clamp(min=DRIEST_PERCENT))
    if law == "brutsaert":
        emissivity = 1.24 * (vapour / air_k) ** (1 / 7)
    elif law == "brunt":
        emissivity = 0.605 + 0.048 * vapour.sqrt()
    else:
        dew = dew_point_c(vapour).clamp(min=LOWEST_DEW_C)
        emissivity = 0.711 + 0.0056 * dew + 0.000073 * dew * dew
    return emissivity.clamp(max=1.0)


def optical_depth(emissivity: Tensor) -> Tensor:
    """Of air to the zenith, where the whole sky has this emissivity."""
    return -(1.0 - emissivity).clamp(min=1e-6).log() / DIFFUSIVITY


def emissivity_towards(depth: Tensor, sine: Tensor) -> Tensor:
    """Emissivity of air of an optical depth to the zenith towards heights of these sines above the horizon; at and below it 1."""
    away = -torch.expm1(-depth / sine.clamp(min=LOWEST_SINE))
    return torch.where(sine > 0, away, 1.0)
