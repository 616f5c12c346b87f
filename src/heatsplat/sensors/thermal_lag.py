"""Thermal lag of a microbolometer: its pixels are warmed by what they see, and take their time."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import Frame
from heatsplat.sensors.base import nonnegative_tanh
from heatsplat.sensors.moving import MovingPart, displaced

REACH = 6.0  # time constants that are looked back; before lie 0.25 % of the answer
FEWEST, MOST = 4, 33  # moments at which the past is looked up


class ThermalLag(MovingPart):
    """τ dy/dt = x - y: a pixel shows the mean of what it saw, weighted by e^{-s/τ} over the time s that has passed since.

    A membrane of heat capacity C on legs of conductance G has τ = C / G, 7 to 15 ms in cameras on sale (P. W. Kruse,
    *Uncooled Thermal Imaging: Arrays, Systems, and Applications*, 2001). To first order in the velocity v of the image
    what a pixel p saw s ago is now at p + v s, so that one image tells all of it: y(p) = ∫ e^{-s/τ}/τ I(p + v (s - a)) ds.

    The lead a is by how much the poses are ahead of the images' clock. Poses that come from images of the same
    camera lag as it does, a = τ, and then only the blur is left; those of a rig have a = 0. Both are learned.

    The integral is exact for what is linear between moments, which lie a pixel apart in the fastest part of the image.

    Args:
        tau_max: bound of τ in seconds.
        lead_max: bound of |a| in seconds; 0 leaves it out.
        weight: of the penalty (τ / tau_max)² + (a / lead_max)².
        lr, lr_end: learning rate and the factor on it at the end of the run.

    Raises:
        ValueError: a bound is out of its range.
    """

    def __init__(
        self, tau_max: float = 0.05, lead_max: float = 0.05, weight: float = 1e-6, lr: float = 0.01, lr_end: float = 0.1
    ) -> None:
        super().__init__()
        if not tau_max > 0 or not lead_max >= 0:
            raise ValueError(f"tau_max must be positive and lead_max not negative, got {tau_max} and {lead_max}")
        self.tau_max, self.lead_max, self.weight, self.lr, self.lr_end = tau_max, lead_max, weight, lr, lr_end
        self.raw_tau = nn.Parameter(torch.zeros(()))
        self.raw_lead = nn.Parameter(torch.zeros(())) if lead_max > 0 else None

    def forward(self, image: Tensor, frame: Frame, depth: Tensor) -> Tensor:
        velocity, tau = self.velocity(frame, depth).to(image), self.tau().to(image)
        farthest = REACH * tau.item() * velocity.norm(dim=-1).max().item()
        ages, weights = moments(min(max(math.ceil(farthest) + 1, FEWEST), MOST))
        passed = tau * ages.to(image)
        if self.raw_lead is not None:
            passed = passed - self.lead().to(image)
        seen = displaced(image, velocity * passed[:, None, None, None])
        return (weights.to(image)[:, None, None, None] * seen).sum(0)

    def tau(self) -> Tensor:
        """τ in seconds, [] in [0, tau_max]; below zero only the gradient goes on."""
        return self.tau_max * nonnegative_tanh(self.raw_tau)

    def lead(self) -> Tensor:
        """a in seconds, []; 0 where it is left out."""
        return self.raw_tau.new_zeros(()) if self.raw_lead is None else self.lead_max * self.raw_lead.tanh()

    def penalty(self) -> Tensor:
        penalty = (self.tau() / self.tau_max).square()
        return penalty if self.raw_lead is None else penalty + (self.lead() / self.lead_max).square()

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"thermal_lag": {"tau_ms": 1e3 * self.tau().item(), "poses_ahead_ms": 1e3 * self.lead().item()}}


def moments(count: int) -> tuple[Tensor, Tensor]:
    """Ages [count] in time constants, evenly from 0 to REACH, and weights [count] that sum to one, float64.

    Their sum is the integral of e^{-s} times the line through each two neighbours, which is exact for lines.
    """
    step = REACH / (count - 1)
    ages = step * torch.arange(count, dtype=torch.float64)
    rise = (1.0 - math.exp(-step)) / step
    near, far = 1.0 - rise, rise - math.exp(-step)  # of the integral over one step, to its nearer and farther end
    start = torch.exp(-ages[:-1])
    weights = torch.zeros(count, dtype=torch.float64)
    weights[:-1] += near * start
    weights[1:] += far * start
    weights[-1] += math.exp(-REACH)  # all that is older
    return ages, weights
