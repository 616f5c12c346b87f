"""The blur of lens and detector: every point becomes a Gaussian spot of one width, which is learned."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from heatsplat.contracts import Frame, SceneData
from heatsplat.sensors.base import SensorPart

REACH = 3.5  # standard deviations that the kernel reaches at its widest; beyond lie 5e-4 of its weight


class PointSpread(SensorPart):
    """Convolution with a discrete Gaussian of variance t, the same in both directions.

    The discrete Gaussian (Lindeberg 1990, Eq. 12: weights e^{-t} I_n(t)) is the heat equation on the pixel grid: weights
    are positive and sum to one, t = 0 is exactly the identity, and there its slope in t is half the image's Laplacian. A
    sampled Gaussian has no slope at width zero and could never leave it.

    Pixels beyond the border are those at it, so that an even image stays even. The width counts in pixels of the training
    images; an image rendered finer is blurred over as many pixels more.

    Args:
        width_max: bound of the standard deviation in pixels of a training image.
        weight: of the penalty t / width_max², which keeps details in the scene that both could explain.
        lr, lr_end: learning rate and the factor on it at the end of the run.

    Raises:
        ValueError: the bound is not positive.
    """

    def __init__(self, width_max: float = 2.0, weight: float = 1e-5, lr: float = 0.01, lr_end: float = 0.1) -> None:
        super().__init__()
        if not width_max > 0:
            raise ValueError(f"width_max is a width in pixels and must be positive, got {width_max}")
        self.width_max, self.weight, self.lr, self.lr_end = width_max, weight, lr, lr_end
        self.raw_spread = nn.Parameter(torch.zeros(()))
        self.register_buffer("trained_width", torch.ones((), dtype=torch.float64))  # of the images, in pixels

    def prepare(self, scene: SceneData) -> None:
        self.trained_width.fill_(scene.train.frames[0].camera.width)

    def forward(self, image: Tensor, frame: Frame) -> Tensor:
        zoom = image.shape[1] / self.trained_width.item()
        radius = math.ceil(REACH * self.width_max * zoom)
        taps = discrete_gaussian(self.variance() * zoom**2, radius).to(image)
        channels = image.shape[2]
        planes = image.permute(2, 0, 1)[None]
        planes = functional.pad(planes, (radius, radius, radius, radius), mode="replicate")
        kernel = taps.expand(channels, 1, 1, -1)
        planes = functional.conv2d(planes, kernel, groups=channels)
        planes = functional.conv2d(planes, kernel.transpose(2, 3), groups=channels)
        return planes[0].permute(1, 2, 0)

    def variance(self) -> Tensor:
        """t in squared pixels of a training image, [] in [0, width_max²]; below zero only the gradient goes on."""
        bounded = self.raw_spread.tanh()
        return self.width_max**2 * (bounded + (bounded.clamp(min=0.0) - bounded).detach())

    def regulariser(self) -> Tensor | None:
        return None if self.weight == 0 else self.weight * self.variance() / self.width_max**2

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"point_spread": {"width_px": self.variance().item() ** 0.5}}


def discrete_gaussian(variance: Tensor, radius: int) -> Tensor:
    """Weights e^{-t} I_n(t) for n = -radius .. radius, [2 radius + 1] float64; they sum to one.

    They are the Fourier coefficients of exp(t (cos ω - 1)). A sum over as many ω as there are weights is theirs on a
    circle: what would lie beyond the radius comes back at the other end.

    Args:
        variance: t, [] in squared pixels; differentiable, at 0 too.
    """
    n = torch.arange(-radius, radius + 1, dtype=torch.float64, device=variance.device)
    omega = 2 * math.pi * n / len(n)
    return (torch.exp(variance.double() * (omega.cos() - 1)) * torch.cos(n[:, None] * omega)).mean(1)
