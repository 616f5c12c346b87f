"""A scene seen through air: what a network stands for in TI-3DGS, as the law of Beer and Lambert over true distances."""

from __future__ import annotations

from torch import Tensor

from heatsplat.contracts import SceneData, check_option
from heatsplat.same_bits import everywhere
from heatsplat.splats import Splats
from heatsplat.thermal.attenuation import Attenuation
from heatsplat.thermal.base import Query, ThermalModel
from heatsplat.thermal.clipping import CLIPS, clipped
from heatsplat.thermal.coordinates import ImageRange
from heatsplat.thermal.wrapper import Wrapper

DEEPEST = 5.0  # optical depth at the typical distance; through more a camera sees nothing but air


class ThroughAir(Wrapper):
    """An emission weakened by the air on its way to the camera, which sends its own heat (``Attenuation``).

    Gaussians carry what they look like from the typical distance between cameras and points. Extinction then acts on what
    differs from there, and can be learned without that all of them have to become brighter meanwhile.

    Args:
        emission: what surfaces send, in image units and not clipped: what leaves the image's range may come back into it.
        air: between them and the camera.
        clip: how values outside the range are shown behind the air: "straight_through", "hard" or "none".

    Raises:
        ValueError: an option is unknown.
    """

    def __init__(self, emission: ThermalModel, air: Attenuation, clip: str = "straight_through") -> None:
        check_option("clip", clip, CLIPS)
        super().__init__({"emission": emission, "air": air})
        self.clip, self.range = clip, ImageRange()

    def prepare(self, scene: SceneData) -> None:
        super().prepare(scene)
        self.range.prepare(scene)

    def changed(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        level, gain = (everywhere(number, values) for number in (self.air.level, self._gain(query.time_s)))
        near = level + (values - level) * gain
        return clipped(self.air(near, splats, query), self.clip)

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor | None:
        """Of the surfaces themselves, without the air."""
        seen = super().temperature(splats, time_s, ids)
        if seen is None:
            return None
        air = self.range.kelvin(self.air.level)
        return air + (seen - air) * self._gain(time_s)

    def _gain(self, time_s: float | None) -> Tensor:
        """How much more of its excess over the air a surface sends than arrives from the typical distance, []."""
        depth = self.air.extinction(time_s) * self.air.typical.to(self.air.log_depth)
        return depth.clamp(max=DEEPEST).exp()
