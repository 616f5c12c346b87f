"""The contract of density control: what decides how many Gaussians there are, and where."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from heatsplat.contracts import Camera, RenderOutput
from heatsplat.density.ops import Cloud


@dataclass(frozen=True)
class DensityChange:
    """What one refinement did: Gaussians added and removed, and whether opacities were reset."""

    added: int = 0
    removed: int = 0
    opacity_reset: bool = False


class DensityControl:
    """Decides which Gaussians are duplicated, split and pruned: gsplat calls it a strategy.

    Its state is a dict of [N, ...] tensors kept outside, in the Cloud. The default does nothing at all, which is ``fixed``.

    Attributes:
        absgrad: whether ``observe`` wants absolute per-pixel gradients.
        cap_max: never more Gaussians than this, from the start on; it may be set during a run. None: no Gaussians are added.
    """

    absgrad: bool = False
    cap_max: int | None = None

    def initial_state(self, count: int, device: torch.device) -> dict[str, Tensor]:
        """Per-Gaussian statistics before the first step, each [count, ...]."""
        return {}

    def observe(self, state: dict[str, Tensor], output: RenderOutput, camera: Camera, step: int) -> None:
        """Takes what it needs from a rendered view after the backward pass. Changes ``state`` in place."""
        return

    def refine(self, cloud: Cloud, step: int, extent: float, generator: torch.Generator) -> DensityChange | None:
        """Adds and removes Gaussians after the optimiser's step, through ``cloud`` only. None when it did nothing.

        Args:
            cloud: splats with their optimiser moments and statistics.
            step: training step, counted from 0.
            extent: length unit of the scene (SceneData.extent).
            generator: for random draws at this step.
        """
        return None

    def settled(self, step: int) -> bool:
        """Whether images after ``step`` tell how good the Gaussians are: not shortly after a reset of opacities."""
        return True
