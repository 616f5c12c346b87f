"""The blur of lens and detector: every point becomes a Gaussian spot of one width, which is learned."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from heatsplat.contracts import Frame, SceneData
from heatsplat.derivatives import once_differentiable
from heatsplat.same_bits import total
from heatsplat.sensors.base import SensorPart, nonnegative_tanh

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

    def prepare(self, scene: SceneData, modality: str = "thermal") -> None:
        self.trained_width.fill_(scene.train.frames[0].camera.width)

    def forward(self, image: Tensor, frame: Frame) -> Tensor:
        zoom = image.shape[1] / self.trained_width.item()
        radius = math.ceil(REACH * self.width_max * zoom)
        variance = self.variance() * zoom**2
        return _Blur.apply(image, variance, radius)

    def variance(self) -> Tensor:
        """t in squared pixels of a training image, [] in [0, width_max²]; below zero only the gradient goes on."""
        return self.width_max**2 * nonnegative_tanh(self.raw_spread)

    def penalty(self) -> Tensor:
        return self.variance() / self.width_max**2

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"point_spread": {"width_px": self.variance().item() ** 0.5}}


class _Blur(torch.autograd.Function):
    """The blur of an image [H, W, C] with a discrete Gaussian of a variance [] and a radius.

    torch differentiates a convolution ten times as slowly as it convolves. Here the adjoint is a convolution, too, and the
    slope in the variance is known: weights change by the heat equation on the grid.
    """

    @staticmethod
    def forward(ctx: Any, image: Tensor, variance: Tensor, radius: int) -> Tensor:
        weights = discrete_gaussian(variance, radius)
        ctx.save_for_backward(image, weights)
        ctx.variance_type = variance.dtype
        return _convolved(_convolved(image, weights, 0), weights, 1)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        image, weights = ctx.saved_tensors
        grad_image = grad_variance = None
        if ctx.needs_input_grad[0]:
            grad_image = _gathered(_gathered(grad, weights, 1), weights, 0)
        if ctx.needs_input_grad[1]:
            slopes = 0.5 * (weights.roll(1) + weights.roll(-1)) - weights
            down = _convolved(_convolved(image, slopes, 0), weights, 1)
            across = _convolved(_convolved(image, weights, 0), slopes, 1)
            grad_variance = total(grad * (down + across)).to(ctx.variance_type)
        return grad_image, grad_variance, None


def _convolved(image: Tensor, weights: Tensor, axis: int) -> Tensor:
    """An image [H, W, C] convolved with symmetric weights [2r + 1] along an axis; beyond the border lies the border."""
    radius = len(weights) // 2
    return _slid(image, weights, axis, radius, "replicate")


def _gathered(grad: Tensor, weights: Tensor, axis: int) -> Tensor:
    """The adjoint of ``_convolved``: what went beyond the border comes back to it."""
    radius, count = len(weights) // 2, grad.shape[axis]
    spread = _slid(grad, weights, axis, 2 * radius, "constant")
    inner = spread.narrow(axis, radius, count).clone()
    inner.narrow(axis, 0, 1).add_(spread.narrow(axis, 0, radius).sum(axis, keepdim=True))
    inner.narrow(axis, count - 1, 1).add_(spread.narrow(axis, radius + count, radius).sum(axis, keepdim=True))
    return inner


def _slid(image: Tensor, weights: Tensor, axis: int, padding: int, mode: str) -> Tensor:
    planes = image.permute(2, 0, 1)[:, None]
    sides = (0, 0, padding, padding) if axis == 0 else (padding, padding, 0, 0)
    kernel = weights.to(image).reshape((1, 1, -1, 1) if axis == 0 else (1, 1, 1, -1))
    return functional.conv2d(functional.pad(planes, sides, mode=mode), kernel)[:, 0].permute(1, 2, 0)


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
