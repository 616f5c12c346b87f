"""The edge enhancement loss of TI-3DGS: differences of gradient magnitudes, and its three-way weighting."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from heatsplat.losses.compose import LossInputs, LossTerm
from heatsplat.losses.masking import eroded, masked_mean
from heatsplat.losses.photometric import Photometric
from heatsplat.losses.sobel import sobel_magnitude


def mean_of_differences(inputs: LossInputs, size: Callable[[Tensor], Tensor]) -> Tensor:
    """The mean over pixels of ``size`` of |∇target| - |∇prediction|, Sobel magnitudes.

    Pixels whose Sobel window touches a masked one are left out, and masked pixels receive no gradient. Without a pixel
    that counts it is 0.

    Raises:
        ValueError: prediction and target differ in shape.
    """
    prediction, target = inputs.unmasked()
    difference = sobel_magnitude(target) - sobel_magnitude(prediction)
    return masked_mean(size(difference), None if inputs.mask is None else eroded(inputs.mask))


class Edge(LossTerm):
    """The mean over pixels of (|∇target| - |∇prediction|)² (TI-3DGS, Eq. 15); see ``mean_of_differences``."""

    def __call__(self, inputs: LossInputs) -> Tensor:
        return mean_of_differences(inputs, torch.square)


class EdgeEnhanced(LossTerm):
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
