"""The edge loss of ThermoGS: how far apart the gradient magnitudes of two images are."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.losses.compose import LossInputs, LossTerm
from heatsplat.losses.edge import mean_of_differences
from heatsplat.losses.sobel import GAIN


class EdgeDifference(LossTerm):
    """The mean over pixels of | |∇target| - |∇prediction| |, slopes per pixel by Sobel (L_edge of ThermoGS, Eq. 11).

    The paper gives no formula. Masks count as in ``edge.mean_of_differences``.
    """

    def __call__(self, inputs: LossInputs) -> Tensor:
        return mean_of_differences(inputs, torch.abs) / GAIN
