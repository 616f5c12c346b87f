"""A tone curve that the data choose: small, smooth corrections of brightness that depend on brightness alone."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from heatsplat.contracts import Frame
from heatsplat.derivatives import once_differentiable
from heatsplat.kernels import tone as kernel
from heatsplat.sensors.base import SensorPart

LEVELS = 256  # the curve between 0 and 1 is kept at this many brightnesses


class Tone(SensorPart):
    """I (1 + m tanh δ_m) + o tanh δ_o with δ_m, δ_o a network's answer to the mean of the channels (SupIR-GS, Eq. 7-8).

    The network sees one number per pixel, so it is a curve. It is evaluated at 256 levels with straight lines between,
    which stays within a quarter of an 8-bit step of asking it at every pixel and costs a thousandth. Brightness beyond
    [0, 1] is corrected like its end.

    A level and a factor that all brightnesses share belong to the scene: the straight line that fits the correction best
    over [0, 1] is taken away, and what stays is the curve's bend.

    The start is fixed, without a draw: bends evenly over [0, 1] in the first layer, an orthogonal mixture of them in
    the second, zero in the last.

    Args:
        width: units of each of the two hidden layers.
        gain_max, offset_max: m and o, the largest change as a factor and in image units.
        weight: of the penalty mean of δ_m² + δ_o² over the levels.
        straight: leaves the straight line in (as the paper prints); brightness is then arbitrary within the bounds.
        exact: asks the network at every pixel (the paper); slow.
        lr, lr_end: learning rate and the factor on it at the end of the run.
    """

    def __init__(
        self,
        width: int = 64,
        gain_max: float = 0.08,
        offset_max: float = 0.04,
        weight: float = 1e-3,
        straight: bool = False,
        exact: bool = False,
        lr: float = 1e-3,
        lr_end: float = 0.01,
    ) -> None:
        super().__init__()
        if width < 2 or min(gain_max, offset_max) < 0:
            raise ValueError(
                f"width must be at least 2, gain_max and offset_max not negative, got {width}, {gain_max}, {offset_max}"
            )
        self.weight, self.lr, self.lr_end = weight, lr, lr_end
        self.straight, self.exact = straight, exact
        first, second, last = nn.Linear(1, width), nn.Linear(width, width), nn.Linear(width, 2)
        self.network = nn.Sequential(first, nn.ReLU(), second, nn.ReLU(), last)
        with torch.no_grad():
            bends = (torch.arange(width) + 0.5) / width
            side = 1.0 - 2.0 * (torch.arange(width) % 2)  # every other unit is active below its bend
            first.weight.copy_(2.0 * side[:, None])
            first.bias.copy_(-2.0 * side * bends)
            row, column = torch.arange(width)[:, None], torch.arange(width)
            mixture = torch.cos(math.pi / width * (column + 0.5) * row) * math.sqrt(2.0 / width)
            mixture[0] /= math.sqrt(2.0)
            second.weight.copy_(math.sqrt(2.0) * mixture)
            for parameter in (second.bias, last.weight, last.bias):
                parameter.zero_()
        self.register_buffer("bounds", torch.tensor([gain_max, offset_max]))
        self.register_buffer("levels", torch.linspace(0.0, 1.0, LEVELS)[:, None])
        self._answers: Tensor | None = None  # of the network at the levels, which the last image and its penalty share

    def forward(self, image: Tensor, frame: Frame) -> Tensor:
        answers = self.network(self.levels)
        self._answers = answers if self.weight and self.training and torch.is_grad_enabled() else None
        curve = self.bounds * answers.tanh()
        line = 0.0 if self.straight else self._line(curve)
        if not self.exact:
            return corrected(image, curve - line)
        brightness = image.mean(2).clamp(0, 1)
        gain, offset = (self.bounds * self.network(brightness[..., None]).tanh() - line).unbind(2)
        return image * (1.0 + gain[..., None]) + offset[..., None]

    def _line(self, curve: Tensor) -> Tensor:
        """Slope and level of the line that fits the correction of a curve [L, 2] best over [0, 1], [2]."""
        correction = self.levels[:, 0] * curve[:, 0] + curve[:, 1]
        offsets = self.levels[:, 0] - 0.5
        slope = (offsets * correction).sum() / offsets.square().sum()
        return torch.stack((slope, correction.mean() - 0.5 * slope))

    def penalty(self) -> Tensor:
        answers, self._answers = self._answers, None
        if answers is None:
            answers = self.network(self.levels)
        return answers.square().sum(1).mean()

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"tone": {"width": self.network[0].out_features}}


def corrected(image: Tensor, curve: Tensor) -> Tensor:
    """I (1 + g(b)) + o(b), [H, W, C], at the mean b of a pixel's channels; by a kernel on a CPU in float32.

    Args:
        image: [H, W, C].
        curve: [L, 2] g and o at evenly spaced brightnesses from 0 to 1, with straight lines between; the ends hold beyond.
    """
    on_cpu = image.device.type == "cpu" and image.dtype == curve.dtype == torch.float32
    return _Corrected.apply(image, curve) if on_cpu else corrected_reference(image, curve)


def corrected_reference(image: Tensor, curve: Tensor) -> Tensor:
    """``corrected`` in plain torch, on any device and in any precision."""
    brightness = image.mean(2)
    where = torch.stack((2.0 * brightness - 1.0, torch.zeros_like(brightness)), 2)
    gain, offset = functional.grid_sample(
        curve.T[None, :, None], where[None], mode="bilinear", padding_mode="border", align_corners=True
    )[0]
    return image * (1.0 + gain[..., None]) + offset[..., None]


class _Corrected(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, curve: Tensor) -> Tensor:
        image, curve = image.detach().contiguous(), curve.detach().contiguous()
        found = torch.empty_like(image)
        kernel.correct(image.view(-1).numpy(), image.shape[2], curve.numpy(), found.view(-1).numpy())
        ctx.save_for_backward(image, curve)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, Tensor]:
        image, curve = ctx.saved_tensors
        v_image, v_curve = torch.empty_like(image), torch.empty_like(curve)
        flat = [tensor.view(-1).numpy() for tensor in (image, grad.contiguous(), v_image)]
        kernel.differentiate(flat[0], image.shape[2], curve.numpy(), *flat[1:], v_curve.numpy())
        return v_image, v_curve
