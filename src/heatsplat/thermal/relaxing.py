"""What models have in common whose Gaussians tend to one temperature of the surroundings."""

from __future__ import annotations

import logging
from abc import abstractmethod

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData, SceneError, check_option
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, ThermalModel
from heatsplat.thermal.clipping import CLIPS, clipped
from heatsplat.thermal.coordinates import Clock, ImageRange

log = logging.getLogger(__name__)


class Relaxing(ThermalModel):
    """Temperatures in image units, 0 at Tmin and 1 at Tmax, over a record whose length is the unit of time.

    A scene without a range is modelled in image values, with no temperature in kelvin.

    Args:
        ambient: "measured" (the scene's, else learned), "learned" (from the measured one, if any) or a number in °C.
        clip: how values outside the range are shown: "straight_through" clamps values but lets gradients pass, so that
            a Gaussian outside comes back; "hard" stops its gradient; "none" shows them as they are.
        lr_ambient, lr_end: learning rate of a learned ambient temperature, and the factor on it at the end of the run.

    Raises:
        ValueError: an option is unknown.
    """

    needs = frozenset({"time"})

    def __init__(self, ambient: str | float, clip: str, lr_ambient: float, lr_end: float) -> None:
        super().__init__()
        check_option("clip", clip, CLIPS)
        if isinstance(ambient, str) and ambient not in ("measured", "learned"):
            raise ValueError(f"ambient must be measured, learned or a number in °C, got '{ambient}'")
        self.clip, self.lr, self.lr_end = clip, lr_ambient, lr_end
        self._ambient_from = ambient
        self._ambient_unknown = False
        self.clock, self.range = Clock(), ImageRange()
        self.register_buffer("ambient", torch.tensor(0.5))

    def prepare(self, scene: SceneData) -> None:
        self.clock.prepare(scene)
        self.range.prepare(scene)
        self._set_ambient(scene)

    def _set_ambient(self, scene: SceneData) -> None:
        celsius = scene.ambient_c if isinstance(self._ambient_from, str) else self._ambient_from
        if not isinstance(self._ambient_from, str) and scene.thermal_range is None:
            raise SceneError(
                f"ambient={celsius} is in °C, but scene '{scene.name}' has no temperature range to relate it to; "
                "use thermal.ambient=learned"
            )
        known = celsius is not None and scene.thermal_range is not None
        learned = self._ambient_from == "learned" or not known
        value = torch.tensor(scene.thermal_range.to_unit(celsius) if known else 0.5, dtype=torch.float32)
        if learned:
            if self._ambient_from == "measured":
                log.warning("scene '%s' has no measured ambient temperature: it is learned", scene.name)
            del self.ambient
            self.ambient = nn.Parameter(value)
        else:
            self.ambient = value
        self._ambient_unknown = not known

    @torch.no_grad()
    def guess_ambient(self, values: Tensor) -> None:
        """Where nothing is known of the ambient temperature, starts from what Gaussians are first seen at [N]: most of a scene
        is near its surroundings."""
        if self._ambient_unknown and len(values) > 0:
            self.ambient.copy_(values.median())

    @property
    def ambient_is(self) -> str:
        """Whether the ambient temperature is "learned" or "fixed"."""
        return "learned" if isinstance(self.ambient, nn.Parameter) else "fixed"

    def features(self, splats: Splats, query: Query) -> Tensor:
        return clipped(self._state(splats, query.time_s, query.ids), self.clip)[:, None]

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor | None:
        return None if self.range.bounds is None else self.range.kelvin(self._state(splats, time_s, ids))

    @abstractmethod
    def _state(self, splats: Splats, time_s: float | None, ids: Tensor | None) -> Tensor:
        """Temperature in image units of the Gaussians ``ids``, [n], not clipped."""
