"""The edge enhancement loss of TI-3DGS: differences of gradient magnitudes, and its three-way weighting."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.losses.compose import LossInputs
from heatsplat.losses.photometric import Photometric

TINY = 1e-12  # under the root of the magnitude, so that a flat image has a gradient of zero and not NaN
GAIN = 8.0  # what the Sobel operator makes of a slope of 1 per pixel


def sobel(image: Tensor) -> tuple[Tensor, Tensor]:
    """Sobel derivatives along x and y, [H, W, C] each.

    **Convention:** the operator as it is usually written, with weights ±1, ±2: 8 times the slope per pixel. The image
    is continued by its border, so that the border is no edge.

    Args:
        image: [H, W, C].
    """
    padded = functional.pad(image.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate")[0].permute(1, 2, 0)
    down = padded[:-2] + 2.0 * padded[1:-1] + padded[2:]
    along = padded[:, :-2] + 2.0 * padded[:, 1:-1] + padded[:, 2:]
    return down[:, 2:] - down[:, :-2], along[2:] - along[:-2]


def sobel_magnitude(image: Tensor) -> Tensor:
    """Norms of the Sobel derivatives, [H, W, C]; at least 1e-6, with finite gradients everywhere."""
    x, y = sobel(image)
    return (x * x + y * y + TINY).sqrt()


def whole_windows(mask: Tensor) -> Tensor:
    """Which pixels [H, W] count together with their eight neighbours (those outside the image do not matter)."""
    masked = functional.max_pool2d((~mask).float()[None, None], 3, stride=1, padding=1)[0, 0]
    return masked < 0.5


def mean_of_differences(inputs: LossInputs, size: Callable[[Tensor], Tensor]) -> Tensor:
    """The mean over pixels of ``size`` of |∇target| - |∇prediction|, Sobel magnitudes; ``size`` of 0 is 0.

    Pixels whose Sobel window touches a masked one are left out, and masked pixels receive no gradient. Without a pixel
    that counts it is 0.

    Raises:
        ValueError: prediction and target differ in shape.
    """
    prediction, target = inputs.unmasked()
    difference = sobel_magnitude(target) - sobel_magnitude(prediction)
    if inputs.mask is None:
        return size(difference).mean()
    counted = whole_windows(inputs.mask)[..., None]
    error = size(torch.where(counted, difference, 0.0))
    return error.sum() / (counted.sum() * error.shape[2]).clamp(min=1)


class Edge:
    """The mean over pixels of (|∇target| - |∇prediction|)² (TI-3DGS, Eq. 15); see ``mean_of_differences``."""

    def __call__(self, inputs: LossInputs) -> Tensor:
        return mean_of_differences(inputs, torch.square)


class EdgeEnhanced:
    """The terms "l1", "dssim" and "edge": (1 - w - e) mean|x - y|, w (1 - mean SSIM) and e times ``Edge`` (Eq. 16).

    Args:
        dssim_weight: w, λ of the paper.
        edge_weight: e, λ_edge of the paper. At 0 the edge term is absent and the rest is ``Photometric``.
        dssim_half: halves 1 - SSIM.

    Raises:
        ValueError: the weights are negative or leave nothing for the L1 term.
    """

    def __init__(self, dssim_weight: float = 0.2, edge_weight: float = 0.1, dssim_half: bool = False) -> None:
        if min(dssim_weight, edge_weight) < 0 or edge_weight >= 1 or dssim_weight + edge_weight > 1:
            raise ValueError(
                "dssim_weight and edge_weight are shares of the loss that leave one for the L1 term, got "
                f"{dssim_weight} and {edge_weight}"
            )
        self.edge_weight = edge_weight
        self.photometric = Photometric(min(dssim_weight / (1.0 - edge_weight), 1.0), dssim_half)
        self.edge = Edge()

    def __call__(self, inputs: LossInputs) -> dict[str, Tensor]:
        if self.edge_weight == 0:
            return self.photometric(inputs)
        terms = {name: (1.0 - self.edge_weight) * value for name, value in self.photometric(inputs).items()}
        return terms | {"edge": self.edge_weight * self.edge(inputs)}
