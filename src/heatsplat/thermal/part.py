"""What happens to heat between the state of a surface and the camera: parts of ``Composed``."""

from __future__ import annotations

from abc import abstractmethod

from torch import Tensor

from heatsplat.splats import Splats
from heatsplat.thermal.base import Heat, Query


class HeatPart(Heat):
    """One effect on what Gaussians emit.

    One part is one file with one subclass and one entry in conf/effects/shared/parts.yaml.
    """

    beyond_record = ""

    @abstractmethod
    def forward(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        """What is left of ``values`` [n, 1] in image units, of the Gaussians in ``query.ids``; the same shape."""
