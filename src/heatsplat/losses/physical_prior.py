"""The physical prior of RaViGS: emissivity and reflectance are shares, and their sum is at most one."""

from __future__ import annotations

from torch import Tensor

from heatsplat.contracts import check_option
from heatsplat.geometry.spherical_harmonics import C0
from heatsplat.losses.compose import LossInputs, LossTerm
from heatsplat.same_bits import mean, sigmoid, total

OF = ("activated", "coefficients")
REDUCTIONS = ("sum", "mean")


def outside(shares: Tensor) -> Tensor:
    """How far values lie outside [0, 1], any shape; 0 within (B of RaViGS, Eq. 15)."""
    return (-shares).relu() + (shares - 1.0).relu()


def kirchhoff_excess(emissivity: Tensor, reflectance: Tensor, tolerance: float) -> Tensor:
    """How far ε + ρ exceeds 1 + δ, any shape; 0 where it does not. A body cannot emit and reflect more than all."""
    return (emissivity + reflectance - (1.0 + tolerance)).relu()


class PhysicalPrior(LossTerm):
    """B(ε)² + B(ρ)² + ReLU(ε + ρ - (1 + δ))² of all Gaussians (RaViGS, Eq. 15), of the constant harmonics.

    Gaussians without both attributes have no such prior, and the term is absent.

    Args:
        tolerance: δ, 0 or more.
        of: "activated" takes ε and ρ as they act, the sigmoid of the constant harmonic: B is then zero by construction
            and the sum is what counts. "coefficients" takes the coefficients of the constant harmonics themselves, as
            the paper prints; it pulls ε and ρ towards 1/2, as a coefficient in [0, 1] is a share of 0.50 to 0.57.
        reduction: "sum" over Gaussians, which pulls on each as it would on one alone, or "mean", as the paper prints: its
            pull falls with their number, and among tens of thousands no image notices it.
        emissivity, reflectance: names of the tensors, [N, 1, 1] before the sigmoid.

    Raises:
        ValueError: ``of`` or ``reduction`` is unknown, or ``tolerance`` is negative.
    """

    def __init__(
        self,
        tolerance: float = 0.05,
        of: str = "activated",
        reduction: str = "sum",
        emissivity: str = "emissivity",
        reflectance: str = "reflectance",
    ) -> None:
        check_option("of", of, OF)
        check_option("reduction", reduction, REDUCTIONS)
        if tolerance < 0:
            raise ValueError(f"tolerance must not be negative, got {tolerance}")
        self.tolerance, self.activated, self.summed = tolerance, of == "activated", reduction == "sum"
        self.names = emissivity, reflectance

    def __call__(self, inputs: LossInputs) -> Tensor | dict[str, Tensor]:
        if not all(name in inputs.splats for name in self.names):
            return {}
        emissivity, reflectance = (inputs.splats[name] for name in self.names)
        excess = 0.0
        if self.activated:
            emissivity, reflectance = (sigmoid(C0 * values) for values in (emissivity, reflectance))
        else:
            excess = outside(emissivity).square() + outside(reflectance).square()
        terms = excess + kirchhoff_excess(emissivity, reflectance, self.tolerance).square()
        return total(terms) if self.summed else mean(terms)
