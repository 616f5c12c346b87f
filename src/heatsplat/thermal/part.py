"""What happens to heat between the state of a surface and the camera: parts of ``Composed``."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData
from heatsplat.splats import Splats
from heatsplat.thermal.base import Heat, Query


class HeatPart(Heat):
    """One effect on what Gaussians emit.

    One part is one file with one subclass and one entry in conf/effects/shared/parts.yaml.
    """

    beyond_record = ""
    level: Tensor

    def know_surroundings(self, scene: SceneData) -> None:
        """Of a part with a buffer ``level``, the image value of the surroundings []: sets it where their temperature was
        measured; else it becomes a parameter, which starts in the middle of the range."""
        known = scene.thermal_range is not None and scene.ambient_c is not None
        level = torch.tensor(scene.thermal_range.to_unit(scene.ambient_c) if known else 0.5)
        if known:
            self.level.copy_(level)
        else:
            del self.level
            self.level = nn.Parameter(level)

    @abstractmethod
    def forward(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        """What is left of ``values`` [n, 1] in image units, of the Gaussians in ``query.ids``; the same shape."""
