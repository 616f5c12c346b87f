"""What a grey surface sends to a thermal camera: its own emission and what it reflects, and the inverse."""

from __future__ import annotations

from torch import Tensor


def radiance(
    emissivity: Tensor, temperature: Tensor, gain: Tensor, reflectance: Tensor, surroundings: Tensor
) -> Tensor:
    """ε σ T⁴ + ρ L, by Stefan and Boltzmann, of any shape.

    **Convention:** units are the caller's. With T in kelvin and σ = 5.67e-8 W/m²/K⁴ it is a flux in W/m²; with T, ε and
    ρ in [0, 1], σ stands for the gain of the camera as well, and the result is an image value.

    Args:
        emissivity: ε.
        temperature: T, not negative.
        gain: σ.
        reflectance: ρ; an opaque body has ρ = 1 - ε (Kirchhoff).
        surroundings: L, the radiance that the surroundings send onto the surface, from all sides alike.
    """
    squared = temperature * temperature
    return emissivity * gain * (squared * squared) + reflectance * surroundings


def temperature_of(
    radiance: Tensor, emissivity: Tensor, gain: Tensor, reflectance: Tensor, surroundings: Tensor
) -> Tensor:
    """The temperature T at which a surface sends ``radiance``; 0 where it reflects more than that already."""
    return ((radiance - reflectance * surroundings).clamp(min=0.0) / (emissivity * gain)).sqrt().sqrt()
