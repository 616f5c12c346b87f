"""TI-3DGS: a network says how the radiance of every Gaussian is weakened on its way to the sensor and through it."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import check_option
from heatsplat.same_bits import mean, sigmoid
from heatsplat.splats import Splats
from heatsplat.thermal.atmospheric_field import AtmosphericField
from heatsplat.thermal.base import ThermalModel

TARGETS = ("radiance", "harmonics")
OFFSET = 0.5  # what harmonics are added to in an emission of 3DGS


class ImagingField(AtmosphericField):
    """Emission times R e^{-(μ_a + μ_s) d}, where a network gives the four from place and time (TI-3DGS, Eq. 9-12).

    The field of ``AtmosphericField`` with the sensitivity R of the sensor, which is 1 at first. R acts only together with
    the level of the emission: it is no measurement, either.

    Args:
        emission: what splats emit before anything weakens it.
        applies_to: "radiance" multiplies what is emitted; "harmonics" multiplies the coefficients, as the paper prints
            (Eq. 12), which leaves the constant 1/2 of an emission as it is. Values that the emission cut off below zero
            count as zero before they are multiplied; with ``Static``, floor=False cuts off only after that, as printed.
        gauge: weight of the penalty (mean R in view - 1)², which keeps the level with the emission.
        exponent: as in ``AtmosphericField``; "positive" also keeps R within (0, 2) by 2 sigmoid. The paper prints no
            constraint, and learns faster for it.
        frames_per_cycle: as in ``AtmosphericField``.
        field: further options of ``AtmosphericField``.

    Raises:
        ValueError: an option is unknown, a size is not positive, or the gauge is negative.
    """

    factor_name = "imaging_factor"
    further = (0.0,)

    def __init__(
        self,
        emission: ThermalModel,
        applies_to: str = "radiance",
        gauge: float = 1e-3,
        exponent: str = "printed",
        frames_per_cycle: float | None = 4.0,
        **field: Any,
    ) -> None:
        check_option("applies_to", applies_to, TARGETS)
        if gauge < 0:
            raise ValueError(f"gauge is a weight and must not be negative, got {gauge}")
        super().__init__(emission, exponent=exponent, frames_per_cycle=frames_per_cycle, **field)
        self.on_radiance, self.gauge = applies_to == "radiance", gauge
        self._sensitivity: Tensor | None = None

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        """The emission's, and "sensitivity_gauge" of the Gaussians that were last evaluated with a gradient."""
        terms = super().regularisers(splats)
        if self._sensitivity is not None and self.gauge > 0:
            terms = terms | {"sensitivity_gauge": self.gauge * (mean(self._sensitivity) - 1.0).square()}
        self._sensitivity = None
        return terms

    def _factor_of(self, raw: Tensor) -> Tensor:
        sensitivity = 2.0 * sigmoid(raw[:, 3]) if self.positive else 1.0 + raw[:, 3]
        if torch.is_grad_enabled():
            self._sensitivity = sensitivity if len(sensitivity) else None  # a mean over no Gaussian in view is NaN
        return sensitivity * super()._factor_of(raw)

    def _weakened(self, emitted: Tensor, factor: Tensor) -> Tensor:
        if self.on_radiance:
            return factor * emitted
        return (factor * (emitted - OFFSET) + OFFSET).clamp(min=0.0)
