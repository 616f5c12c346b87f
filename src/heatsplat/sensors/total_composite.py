"""Blends what surfaces send at all wavelengths together: Stefan and Boltzmann's T⁴."""

from __future__ import annotations

from torch import Tensor

from heatsplat.sensors.composite import RadianceComposite

COLDEST_K = 1.0  # the fourth root has no slope at 0


class TotalComposite(RadianceComposite):
    """Compositing of T⁴, to which all that a black body sends is proportional.

    Temperatures below 1 K count as that.
    """

    def radiance(self, temperature_k: Tensor) -> Tensor:
        return temperature_k.clamp(min=COLDEST_K).square().square()

    def temperature(self, radiance: Tensor) -> Tensor:
        return radiance.clamp(min=COLDEST_K).sqrt().sqrt()
