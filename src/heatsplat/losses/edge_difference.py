"""The edge loss of ThermoGS: how far apart the gradient magnitudes of two images are."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.losses.compose import LossInputs
from heatsplat.losses.edge import GAIN, sobel_magnitude, whole_windows


class EdgeDifference:
    """The mean over pixels of | |∇target| - |∇prediction| |, slopes per pixel by Sobel (L_edge of ThermoGS, Eq. 11).

    The paper gives no formula. Pixels whose Sobel window touches a masked one are left out, and masked pixels receive no
    gradient. Without a pixel that counts the loss is 0.
    """

    def __call__(self, inputs: LossInputs) -> Tensor:
        prediction, target = inputs.prediction, inputs.target
        if prediction.shape != target.shape:
            raise ValueError(
                f"prediction and target must have one shape, got {list(prediction.shape)} and {list(target.shape)}"
            )
        if inputs.mask is None:
            return (sobel_magnitude(target) - sobel_magnitude(prediction)).abs().mean() / GAIN
        inside = inputs.mask[..., None]
        prediction, target = (torch.where(inside, image, 0.0) for image in (prediction, target))
        counted = whole_windows(inputs.mask)[..., None]
        error = torch.where(counted, (sobel_magnitude(target) - sobel_magnitude(prediction)).abs(), 0.0)
        return error.sum() / (counted.sum() * error.shape[2]).clamp(min=1) / GAIN
