"""Blends radiance: what detectors add up where surfaces share a pixel."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from heatsplat.contracts import SceneData, SceneError, ThermalRange
from heatsplat.physics.units import kelvin
from heatsplat.sensors.base import Composite


class RadianceComposite(Composite):
    """Blends what surfaces of these temperatures send, and shows the temperature of a surface that sends that much.

    Blended is the share (L - L_min)/(L_max - L_min) of the radiance over the scene's range: weights in a pixel, with the
    background's, add up to one, so that it makes no difference but to keep digits. Inside is float64.
    """

    def __init__(self) -> None:
        super().__init__()
        self._range: ThermalRange | None = None
        self._ends = (0.0, 1.0)

    @abstractmethod
    def radiance(self, temperature_k: Tensor) -> Tensor:
        """What a surface sends, rising with its temperature in kelvin."""

    @abstractmethod
    def temperature(self, radiance: Tensor) -> Tensor:
        """The inverse, in kelvin."""

    def prepare(self, scene: SceneData, modality: str) -> None:
        if modality != "thermal":
            raise SceneError(
                f"composite blends the radiance of thermal images, but this method explains {modality} images"
            )
        if scene.thermal_range is None:
            raise SceneError(
                f"scene '{scene.name}' does not say which temperatures its image values are, so that they have no radiance: "
                "give the data set its thermal range, or blend image values with composite=temperature"
            )
        self._range = scene.thermal_range
        ends = torch.tensor([self._range.min_c, self._range.max_c], dtype=torch.float64)
        self._ends = tuple(self.radiance(kelvin(ends)).tolist())

    def encode(self, values: Tensor, channels: int) -> Tensor:
        low, high = self._ends
        celsius = self._range.to_celsius(values[..., :channels].double())
        share = (self.radiance(kelvin(celsius)) - low) / (high - low)
        return self._beside(share, values, channels)

    def decode(self, blended: Tensor, channels: int) -> Tensor:
        low, high = self._ends
        radiance = low + (high - low) * blended[..., :channels].double()
        values = (self.temperature(radiance) - kelvin(self._range.min_c)) / self._range.span_k
        return self._beside(values, blended, channels)

    @staticmethod
    def _beside(thermal: Tensor, values: Tensor, channels: int) -> Tensor:
        """The thermal channels beside those of companions, in the type of the latter."""
        thermal = thermal.to(values)
        return thermal if values.shape[-1] == channels else torch.cat((thermal, values[..., channels:]), -1)
