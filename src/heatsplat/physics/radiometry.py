"""From what a thermal camera measures to the temperature of a surface: the radiometric chain, its inverse, its uncertainty.

A camera sees the surface's own radiation, what the surface reflects, and what the air and a window in between add:

    measured = w [τ (ε S(T) + (1 - ε) S(T_reflected)) + (1 - τ) S(T_air)] + (1 - w) S(T_window)

with the emissivity ε, the transmittances τ of the air and w of the window, and S(T), the signal of a black body. That is the
formula that FLIR documents for its cameras (GenICam manuals of the A series: K1 and K2; user manuals, "The measurement
formula"), and that of W. Minkina and S. Dudzik, Infrared Thermography: Errors and Uncertainties, Wiley 2009, ch. 3. The
weights sum to one, so S may have any gain and offset.

**Convention:** kelvin, metres, fractions; everything is float64 inside.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Protocol

import torch
from torch import Tensor

from heatsplat.physics.planck import Band
from heatsplat.physics.units import KELVIN_AT_0_C

Quantity = float | Tensor


class Response(Protocol):
    """How strongly a camera answers to a black body, up to gain and offset."""

    def signal(self, kelvin: Tensor) -> Tensor:
        """Signal of black bodies at temperatures in kelvin, of any shape."""

    def kelvin(self, signal: Tensor) -> Tensor:
        """Temperatures of black bodies of a signal; NaN where none has it."""


@dataclass(frozen=True)
class PlanckResponse:
    """A FLIR camera's calibration: counts = R1 / (R2 (e^(B/T) - F)) - O."""

    r1: float
    b: float
    f: float
    o: float
    r2: float

    def signal(self, kelvin: Tensor) -> Tensor:
        """Counts of black bodies; NaN where e^(B/T) does not exceed F."""
        # e^x - F is expm1(x) + (1 - F): F is 1 in most files, and B/T small at high temperatures.
        below = torch.expm1(self.b / kelvin) + (1.0 - self.f)
        return torch.where(below > 0, self.r1 / (self.r2 * below) - self.o, math.nan)

    def kelvin(self, signal: Tensor) -> Tensor:
        """Temperatures of counts; NaN where the formula has no answer."""
        above = self.r1 / (self.r2 * (signal + self.o))
        found = self.b / torch.log1p(above + (self.f - 1.0))
        return torch.where((above > 0) & (found > 0), found, math.nan)


@dataclass(frozen=True)
class BandResponse:
    """A camera that sees a band of wavelengths, for files that hold temperatures: the signal is the radiance by Planck's law."""

    band: Band = Band(nodes=16)  # all digits from 150 K on

    def signal(self, kelvin: Tensor) -> Tensor:
        """Radiance of black bodies in W/(m² sr)."""
        return self.band.radiance(kelvin)

    def kelvin(self, signal: Tensor) -> Tensor:
        """Temperatures of a radiance; NaN where it is not positive."""
        return torch.where(signal > 0, self.band.temperature(signal), math.nan)


@dataclass(frozen=True)
class Atmosphere:
    """FLIR's constants of the air's transmittance; the defaults are those that its cameras write into their files."""

    alpha_1: float = 0.006569
    alpha_2: float = 0.012620
    beta_1: float = -0.002276
    beta_2: float = -0.006670
    x: float = 1.9


@dataclass(frozen=True)
class Conditions:
    """What stands between a surface and a camera; each a number, or a tensor with a value for each pixel.

    The defaults are those of no correction at all: a black body, no air, no window.

    Args:
        emissivity: of the surface, in (0, 1].
        reflected_k: apparent temperature of what the surface reflects.
        distance_m: from camera to surface.
        air_k: temperature of the air.
        humidity: relative, 0 to 1.
        window_transmission: in (0, 1]; 1 without a window.
        window_k: temperature of the window.
        atmosphere: constants of the air.
    """

    emissivity: Quantity = 1.0
    reflected_k: Quantity = 293.15
    distance_m: Quantity = 0.0
    air_k: Quantity = 293.15
    humidity: Quantity = 0.5
    window_transmission: Quantity = 1.0
    window_k: Quantity = 293.15
    atmosphere: Atmosphere = field(default_factory=Atmosphere)

    @property
    def corrects(self) -> bool:
        """Whether they change anything: a black body close by, without a window, is measured as it is."""
        return not all(
            isinstance(value, (int, float)) and value == neutral
            for value, neutral in ((self.emissivity, 1.0), (self.distance_m, 0.0), (self.window_transmission, 1.0))
        )

    def transmittance(self) -> Tensor:
        """τ of the air between surface and camera (``transmittance``)."""
        return transmittance(self.distance_m, self.air_k, self.humidity, self.atmosphere)


# What a thermographer can mean; what lies outside was not meant, or was damaged.
LIMITS = {
    "emissivity": (1e-3, 1.0),
    "reflected_k": (1.0, 5000.0),
    "distance_m": (0.0, 1e5),
    "air_k": (150.0, 400.0),
    "humidity": (0.0, 1.0),
    "window_transmission": (1e-3, 1.0),
    "window_k": (1.0, 2000.0),
}
PARAMETERS = tuple(LIMITS)


def _double(value: Quantity) -> Tensor:
    return torch.as_tensor(value, dtype=torch.float64)


def water_vapour(air_k: Quantity, humidity: Quantity) -> Tensor:
    """Water in the air in g/m³ by FLIR's cubic of the temperature in °C, which holds from about -40 to 60 °C."""
    t = _double(air_k) - KELVIN_AT_0_C
    return _double(humidity) * torch.exp(1.5587 + t * (6.939e-2 + t * (-2.7816e-4 + t * 6.8455e-7)))


def transmittance(
    distance_m: Quantity, air_k: Quantity, humidity: Quantity, atmosphere: Atmosphere | None = None
) -> Tensor:
    """Share of thermal radiation (7.5 - 13 µm) that the air lets pass, by FLIR's formula.

    x e^(-√d (α1 + β1 √ω)) + (1 - x) e^(-√d (α2 + β2 √ω)), with ω of ``water_vapour``.

    **Convention:** at long distances through wet air the formula falls below zero; there the result is NaN. Its slopes by
    the distance at 0 m and by the humidity at 0 are infinite, and count as 0 there.
    """
    a = atmosphere or Atmosphere()
    root, wet = _root(_double(distance_m)), _root(water_vapour(air_k, humidity))
    found = a.x * torch.exp(-root * (a.alpha_1 + a.beta_1 * wet)) + (1.0 - a.x) * torch.exp(
        -root * (a.alpha_2 + a.beta_2 * wet)
    )
    return torch.where(found > 0, found.clamp(max=1.0), math.nan)


def _root(values: Tensor) -> Tensor:
    """Square root whose slope at 0 is 0."""
    there = values > 0
    return torch.where(there, torch.where(there, values, 1.0).sqrt(), 0.0)


def _of_itself_and_the_rest(response: Response, conditions: Conditions) -> tuple[Tensor, Tensor]:
    """(weight of the surface's own signal, signal of all else) in what a camera measures."""
    c = conditions
    emissivity, window, air = _double(c.emissivity), _double(c.window_transmission), c.transmittance()
    reflected, in_air, in_window = (response.signal(_double(k)) for k in (c.reflected_k, c.air_k, c.window_k))
    rest = window * (air * (1.0 - emissivity) * reflected + (1.0 - air) * in_air) + (1.0 - window) * in_window
    return window * air * emissivity, rest


def measured_signal(surface_k: Tensor, response: Response, conditions: Conditions) -> Tensor:
    """Signal that a camera measures of a surface at a temperature."""
    weight, rest = _of_itself_and_the_rest(response, conditions)
    return weight * response.signal(surface_k) + rest


def surface_temperature(signal: Tensor, response: Response, conditions: Conditions) -> Tensor:
    """Temperature in kelvin of the surface behind a measured signal; NaN where the conditions alone send more than that."""
    if not conditions.corrects:
        return response.kelvin(signal)
    weight, rest = _of_itself_and_the_rest(response, conditions)
    return response.kelvin((signal - rest) / weight)


def sensitivities(signal: Tensor, response: Response, conditions: Conditions) -> dict[str, Tensor]:
    """Derivatives of ``surface_temperature`` by each of ``PARAMETERS`` and by "camera", its apparent temperature.

    In K per unit of the parameter, and K per K for the camera; each of the signal's shape.
    """
    apparent = response.kelvin(signal.double()).detach()
    given = {
        name: _double(getattr(conditions, name)).expand(signal.shape).clone().requires_grad_() for name in PARAMETERS
    }
    apparent = apparent.requires_grad_()
    found = surface_temperature(response.signal(apparent), response, replace(conditions, **given))
    slopes = torch.autograd.grad(found.sum(), [*given.values(), apparent])
    return dict(zip([*PARAMETERS, "camera"], slopes, strict=True))


def uncertainty(
    signal: Tensor, response: Response, conditions: Conditions, standard: Mapping[str, float]
) -> dict[str, Tensor]:
    """Standard uncertainty of the surface's temperature in K: what each input brings, and under "combined" all together.

    By the law of propagation of uncertainty (JCGM 100:2008, GUM, eq. 10) for inputs that are independent of each other. Where
    the air is dry, of which the slope tells nothing, the humidity brings what its standard uncertainty itself changes.

    Args:
        standard: standard uncertainties in the units of the parameters; "camera" is that of the apparent temperature in K.
    """
    slopes = sensitivities(signal, response, conditions)
    parts = {name: slopes[name].abs() * value for name, value in standard.items()}
    dry = _double(conditions.humidity) == 0
    if "humidity" in standard and bool(dry.any()):
        moist = replace(conditions, humidity=torch.where(dry, standard["humidity"], _double(conditions.humidity)))
        there, here = (surface_temperature(signal, response, c) for c in (moist, conditions))
        parts["humidity"] = torch.where(dry, (there - here).abs(), parts["humidity"])
    return parts | {"combined": torch.stack([torch.zeros_like(signal), *parts.values()]).square().sum(0).sqrt()}


def directional_emissivity(normal: Quantity, cosine: Tensor, index: float) -> Tensor:
    """Emissivity of a smooth dielectric seen at an angle: that along its normal, less as Fresnel's reflectance grows.

    ε(θ) = ε(0) (1 - R(θ)) / (1 - R(0)) with R of unpolarised light; 1.5 is common for paint, brick, plastics and water-poor
    materials in the thermal infrared.

    Args:
        normal: ε(0).
        cosine: cos θ between line of sight and normal, in [0, 1], of any shape.
        index: refractive index n, above 1.
    """
    inside = (1.0 - (1.0 - cosine.double().square()) / index**2).sqrt()
    across = ((cosine - index * inside) / (cosine + index * inside)).square()
    along = ((index * cosine - inside) / (index * cosine + inside)).square()
    return normal * (1.0 - 0.5 * (across + along)) / (1.0 - ((index - 1.0) / (index + 1.0)) ** 2)
