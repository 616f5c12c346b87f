"""RaViGS's density control: a Gaussian stays only while every modality sees it."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.contracts import Camera, RenderOutput
from heatsplat.density.base import DensityChange, DensityControl
from heatsplat.density.ops import Cloud


class CoSupport(DensityControl):
    """Co-support pruning (RaViGS, Eq. 11) on top of another recipe.

    The recipe works as ever: gradients of all modalities reach the screen positions, and with them its statistic.
    Whenever it has refined the cloud, Gaussians go whose opacity is below the threshold in some modality, so that the
    modalities cannot part into two clouds. A pane that is wholly clear in one band cannot be kept in this way (as the
    paper says); the recipe alone, which asks for one modality, keeps it.

    Args:
        recipe: density control that this one extends; its statistics and refinements are left as they are.
        prune_opacity: τ, the least opacity in every modality.
    """

    def __init__(self, recipe: DensityControl, prune_opacity: float = 0.005) -> None:
        self.recipe, self.prune_opacity = recipe, prune_opacity
        self.absgrad = recipe.absgrad

    def initial_state(self, count: int, device: torch.device) -> dict[str, Tensor]:
        """The recipe's statistics; co-support keeps none."""
        return self.recipe.initial_state(count, device)

    def observe(self, state: dict[str, Tensor], output: RenderOutput, camera: Camera, step: int) -> None:
        self.recipe.observe(state, output, camera, step)

    @torch.no_grad()
    def refine(self, cloud: Cloud, step: int, extent: float, generator: torch.Generator) -> DensityChange | None:
        change = self.recipe.refine(cloud, step, extent, generator)
        if change is None:
            return None
        keep = (cloud.splats.opacities >= self.prune_opacity).all(dim=0)
        removed = int((~keep).sum())
        if removed == len(cloud):
            raise RuntimeError(
                f"co-support pruning would remove all {removed} Gaussians at step {step}: each has an opacity below "
                f"{self.prune_opacity} in some modality. Lower density.prune_opacity, or take density=adaptive."
            )
        if removed:
            cloud.keep(keep)
        return DensityChange(change.added, change.removed + removed, change.opacity_reset)
