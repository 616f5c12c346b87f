"""What happens to heat between the state of a surface and the camera: parts of ``Composed``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

from torch import Tensor, nn

from heatsplat.contracts import SceneData
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Query, Seeds


class HeatPart(nn.Module, ABC):
    """One effect on what Gaussians emit. One part is one file with one subclass and one entry in conf/effects/shared/parts.yaml.

    Class attributes:
        needs: metadata without which it cannot be simulated, as of a thermal model.
        lr: learning rate of its own parameters (those that are not per Gaussian).
        lr_end: factor on it at the last step of the run, log-linear in between.
    """

    needs: frozenset[str] = frozenset()
    lr: float = 1e-3
    lr_end: float = 1.0

    def prepare(self, scene: SceneData) -> None:
        """Takes constants from the scene. Called once, before anything else."""
        return

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        """The tensors that every Gaussian carries for it."""
        return {}

    def on_step(self, step: int) -> None:
        """Told the training step before it runs."""
        return

    @abstractmethod
    def forward(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        """What is left of ``values`` [n, 1] in image units, of the Gaussians in ``query.ids``; the same shape."""

    def regularisers(self) -> dict[str, Tensor]:
        """Extra loss terms by name, each a weighted scalar with a gradient."""
        return {}

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        """Quantities of the Gaussians in ``query.ids`` that are worth a picture, by name, each [n]."""
        return {}

    @abstractmethod
    def effects(self) -> dict[str, dict[str, Any]]:
        """The effect by its catalogue name, with settings."""

    @property
    @abstractmethod
    def cost(self) -> int:
        """Multiply-adds per Gaussian and view."""
