"""The temperature consistency loss of Thermal3D-GS: absolute differences that count where the target has corners."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import check_option
from heatsplat.losses.compose import LossInputs, LossTerm
from heatsplat.losses.masking import cleared, eroded, masked_mean
from heatsplat.losses.sobel import sobel

KAPPA = 0.04  # κ of the response (Harris and Stephens 1988)
SIGMA = 1.0  # pixels, of the window
RADIUS = 4  # pixels that the window reaches
LEVELS = 255.0  # grey levels that the published code counts images in
WEIGHTS = ("corners", "published")


def harris_response(x: Tensor, y: Tensor) -> Tensor:
    """det M - κ (tr M)², [H, W, C], with M the products of slopes under a Gaussian window (Harris and Stephens 1988).

    Args:
        x, y: [H, W, C] slopes of an image.
    """
    products = torch.cat((x * x, y * y, x * y), 2).permute(2, 0, 1)[:, None]
    offsets = torch.arange(-RADIUS, RADIUS + 1, dtype=x.dtype, device=x.device)
    window = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    window = window / window.sum()
    products = functional.conv2d(functional.pad(products, (RADIUS,) * 4), window.reshape(1, 1, 1, -1))
    products = functional.conv2d(products, window.reshape(1, 1, -1, 1))
    xx, yy, xy = products[:, 0].permute(1, 2, 0).split(x.shape[2], dim=2)
    return xx * yy - xy * xy - KAPPA * (xx + yy).square()


def _slopes(image: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    """Sobel slopes of an image without masked pixels, [H, W, C] each; 0 beside masked pixels, so that a mask is no corner."""
    counted = None if mask is None else eroded(mask)
    x, y = sobel(image)
    return cleared(x, counted), cleared(y, counted)


class Corner(LossTerm):
    """The mean over pixels of w |target - prediction| with w = max(R / R_max, floor), R the target's Harris response.

    Thermal3D-GS, Eq. 12, where R is of a window and of the target. A target without corners counts with w = floor.
    Masked pixels neither count nor receive a gradient; without a pixel that counts the loss is 0.

    Args:
        weight: "corners", or "published" as the code has it: w = e^R / e^R_max of the prediction in 255 grey levels without
            a window, which is 1 where the image is flat and 0 at all edges and corners. No gradient passes through w.
        floor: smallest w.

    Raises:
        ValueError: the weight is unknown, or floor is outside [0, 1]; or, when called, shapes differ.
    """

    def __init__(self, weight: str = "corners", floor: float = 0.01) -> None:
        check_option("weight", weight, WEIGHTS)
        if not 0 <= floor <= 1:
            raise ValueError(f"floor is a weight in [0, 1], got {floor}")
        self.published, self.floor = weight == "published", floor

    def __call__(self, inputs: LossInputs) -> Tensor:
        (prediction, target), mask = inputs.unmasked(), inputs.mask
        with torch.no_grad():
            weight = self._published(prediction, mask) if self.published else self._corners(target, mask)
        return masked_mean(weight * (target - prediction).abs(), mask)

    def _corners(self, target: Tensor, mask: Tensor | None) -> Tensor:
        # R is of fourth order in contrast; of slopes up to 1 it neither underflows nor overflows.
        x, y = _slopes(target, mask)
        tiny = torch.finfo(target.dtype).tiny
        steepest = torch.maximum(x.abs().max(), y.abs().max()).clamp(min=tiny)
        response = harris_response(x / steepest, y / steepest)
        return (response / response.max().clamp(min=tiny)).clamp(min=self.floor)

    @staticmethod
    def _published(prediction: Tensor, mask: Tensor | None) -> Tensor:
        x, y = _slopes(LEVELS * prediction, mask)
        response = (-KAPPA * (x * x + y * y).square()).clamp(min=torch.finfo(x.dtype).min)
        return torch.exp(response - response.max())
