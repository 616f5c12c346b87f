"""Thermal3D-GS: heat that conduction spreads shows as a learned correction of the image where its brightness bends."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import Frame, SceneData, check_option
from heatsplat.same_bits import to_one
from heatsplat.sensors.base import SensorPart

NORMS = ("image", "columns", "none")
TINY = 1e-6  # image units, under the size that a layer's answer is divided by


class ConductionResidual(SensorPart):
    """I + b tanh(n(I, |∂²I/∂x²| + |∂²I/∂y²|) / b) with a small network n, asked at every pixel (Thermal3D-GS, section 3.3).

    The two maps are what one step of the heat equation I_t = κ ∇²I needs. The network's hidden layers see nothing but
    their pixel, are normalised and pass a ReLU; its last layer starts at zero. The start is fixed, without a draw: units
    that weigh brightness and curvature evenly differently, each of which is active somewhere.

    Where it departs from the published code: that normalises an image without a batch axis, so that columns of it
    share a size (norm "columns"), and its last layer too has norm and ReLU, so that it starts anywhere and only brightens.

    **Convention:** curvatures are differences to the next pixels, with none across the border, per squared pixel of a
    training image whatever the size of the image is. Images with several
    channels get one correction, of the mean of their channels.

    Args:
        width: units of a hidden layer (published: 1).
        hidden: number of hidden layers (published: 2).
        norm: what a unit's answer is divided by: "image": its root mean square over the image; "columns": the root of
            the sum of squares over each column, as published; "none".
        bound: b, the largest correction in image units.
        lr, lr_end: learning rate and the factor on it at the end of the run.

    Raises:
        ValueError: an option is unknown or a size is not positive.
    """

    def __init__(
        self,
        width: int = 4,
        hidden: int = 2,
        norm: str = "image",
        bound: float = 0.1,
        lr: float = 1.6e-5,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__()
        check_option("norm", norm, NORMS)
        if width < 1 or hidden < 1 or not bound > 0:
            raise ValueError(f"width, hidden and bound must be positive, got {width}, {hidden}, {bound}")
        self.norm, self.bound, self.lr, self.lr_end = norm, bound, lr, lr_end
        self.layers = nn.ModuleList(nn.Linear(2 if i == 0 else width, width) for i in range(hidden))
        self.last = nn.Linear(width, 1)
        self.register_buffer("trained_width", torch.zeros((), dtype=torch.float64))  # of the images, in pixels; 0: any
        with torch.no_grad():
            angles = math.pi * ((torch.arange(width) + 0.5) / width - 0.25)
            self.layers[0].weight.copy_(torch.stack((angles.cos(), angles.sin()), 1))
            for layer in self.layers[1:]:
                layer.weight.copy_(torch.eye(width))
            for parameter in (*(layer.bias for layer in self.layers), self.last.weight, self.last.bias):
                parameter.zero_()

    def prepare(self, scene: SceneData, modality: str = "thermal") -> None:
        self.trained_width.fill_(scene.train.frames[0].camera.width)

    def forward(self, image: Tensor, frame: Frame) -> Tensor:
        brightness = image.mean(2)
        zoom = image.shape[1] / (self.trained_width.item() or image.shape[1])
        values = torch.stack((brightness, zoom**2 * curvature(brightness)), 2)
        for layer in self.layers:
            values = self._normalised(layer(values), zoom).relu()
        found = to_one(values, self.last.weight, self.last.bias)
        return image + self.bound * torch.tanh(found / self.bound)

    def _normalised(self, values: Tensor, zoom: float) -> Tensor:
        """Answers [H, W, width] of a layer over their size, for an image so many times as fine as the training images."""
        if self.norm == "none":
            return values
        if self.norm == "image":
            return values / (values.square().mean((0, 1), keepdim=True) + TINY**2).sqrt()
        return values / (values.square().sum(0, keepdim=True) / zoom + TINY**2).sqrt()

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"conduction": {"network": f"{self.last.in_features} x {len(self.layers)} per pixel", "norm": self.norm}}


def curvature(image: Tensor) -> Tensor:
    """|∂²I/∂x²| + |∂²I/∂y²| of an image [H, W], per pixel squared; nothing flows across the border."""
    total = torch.zeros_like(image)
    for axis in (0, 1):
        edge = torch.zeros_like(image.narrow(axis, 0, 1))
        flow = torch.cat((edge, image.diff(dim=axis), edge), axis)
        total = total + flow.diff(dim=axis).abs()
    return total
