"""Blends what a camera's band receives: Planck's law between two wavelengths."""

from __future__ import annotations

from torch import Tensor

from heatsplat.physics.planck import Band
from heatsplat.sensors.composite import RadianceComposite


class BandComposite(RadianceComposite):
    """Compositing of the radiance of black bodies within a band.

    Args:
        shortest_um, longest_um: ends of the band in micrometres.
        nodes: of the integral over it; 12 keep all digits from 150 K on.
    """

    def __init__(self, shortest_um: float = 7.5, longest_um: float = 14.0, nodes: int = 12) -> None:
        super().__init__()
        self.band = Band(shortest_um, longest_um, nodes)

    def radiance(self, temperature_k: Tensor) -> Tensor:
        return self.band.radiance(temperature_k)

    def temperature(self, radiance: Tensor) -> Tensor:
        return self.band.temperature(radiance)
