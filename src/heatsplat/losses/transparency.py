"""Penalties that make Gaussians that are not needed transparent and small: the regularisers of 3DGS-MCMC."""

from __future__ import annotations

from torch import Tensor

from heatsplat.contracts import SceneData
from heatsplat.losses.compose import LossInputs, LossTerm
from heatsplat.same_bits import mean


class MeanOpacity(LossTerm):
    """Mean opacity of all Gaussians, over modalities too (Kheradmand et al. 2024, Eq. 12)."""

    def __call__(self, inputs: LossInputs) -> Tensor:
        return mean(inputs.splats.opacities)


class MeanSize(LossTerm):
    """Mean semi-axis of all Gaussians in extents of the scene (Kheradmand et al. 2024, Eq. 12, in world units)."""

    def __init__(self) -> None:
        self._extent = 1.0

    def prepare(self, scene: SceneData, modality: str) -> dict[str, str]:
        """Takes the extent of the scene."""
        self._extent = scene.extent
        return {}

    def __call__(self, inputs: LossInputs) -> Tensor:
        return mean(inputs.splats.scales) / self._extent
