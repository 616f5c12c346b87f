"""Air between a surface and the camera that swallows its heat and sends its own."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import Course, SceneData
from heatsplat.physics.curves import cubic_rows, resampled_values
from heatsplat.same_bits import everywhere
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query
from heatsplat.thermal.coordinates import Clock
from heatsplat.thermal.part import HeatPart

LOG_DEPTHS = (-12.0, 3.0)  # of β times the typical distance: from nothing to a wall of fog, finite in float32


class Attenuation(HeatPart):
    """x e^{-β d} + A (1 - e^{-β d}) of what a surface emits at distance d from the camera (Beer and Lambert; air at A).

    The extinction β is one number of the scene, or a curve over the record whose logarithm is cubic between evenly spread
    moments; a scene without time has one number.
    A is the temperature of the surroundings where it was measured, else it is learned.

    **Convention:** d and 1/β in world units. The distance passes no gradient to the positions: haze must not move walls.

    Args:
        depth: β times the typical distance between cameras and points (``SceneData.distance``), at the start: a number, or
            several that are evenly spread over the record and resampled to the moments; positive.
        moments: of the curve; 0 keeps β the same throughout.
        smooth: weight of the penalty on the mean squared second derivative of β times the typical distance, over the record as 1.
            Where no training view looks, the curve goes on as it bends on both sides. It is not that of log β, which
            bends less the thicker the air: heat that is lost everywhere alike would be given to it.
        lr, lr_end: learning rate of log β and of A, and the factor on it at the end of the run.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(
        self,
        depth: float | Sequence[float] = 0.1,
        moments: int = 12,
        smooth: float = 1e-8,
        lr: float = 0.01,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__()
        depths = [depth] if isinstance(depth, (int, float)) else list(depth)
        if min(depths, default=0.0) <= 0 or moments == 1 or moments < 0:
            raise ValueError(f"depth must be positive and moments 0 or at least 2, got {depth} and {moments}")
        self.moments, self.smooth, self.lr, self.lr_end = moments, smooth, lr, lr_end
        self.log_depth = nn.Parameter(resampled_values(depths, max(1, moments)).log())
        self.register_buffer("level", torch.tensor(0.5))
        self.register_buffer("typical", torch.ones((), dtype=torch.float64))  # distance in world units
        if moments > 0:
            self.clock = Clock()
            self.beyond_record = "the air stays as at the nearest moment of the record"

    def prepare(self, scene: SceneData) -> None:
        self.typical.fill_(scene.distance)
        self.know_surroundings(scene)
        if self.moments > 0 and "time" not in scene.metadata:
            self.moments = 0
            del self.clock
            self.log_depth = nn.Parameter(self.log_depth.detach().exp().mean().log()[None])
        if self.moments > 0:
            self.clock.prepare(scene)

    def forward(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        level = everywhere(self.level, values)
        return level + (values - level) * self.transmission(splats, query)

    def transmission(self, splats: Splats, query: Query) -> Tensor:
        """e^{-β d}, [n, 1]."""
        if query.camera is None:
            raise ValueError("how much air lies in between depends on the view: give a camera")
        means = query.rows(splats.means).detach()
        distances = (means - query.camera.center.to(means)).norm(dim=1, keepdim=True)
        return torch.exp(-everywhere(self.extinction(query.time_s), distances) * distances)

    def extinction(self, time_s: float | None = None) -> Tensor:
        """β at a time, [] in 1 per world unit."""
        return self._log_depth_at(time_s).clamp(*LOG_DEPTHS).exp() / self.typical.to(self.log_depth)

    def _log_depth_at(self, time_s: float | None) -> Tensor:
        if self.moments == 0:
            return self.log_depth[0]
        place = torch.tensor([self.clock.within(time_s) * (self.moments - 1)], dtype=torch.float64)
        return cubic_rows(place, self.moments)[0].to(self.log_depth) @ self.log_depth

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        if self.moments < 3 or self.smooth == 0:
            return {}
        bends = self.log_depth.clamp(*LOG_DEPTHS).exp().diff(n=2) * (self.moments - 1) ** 2
        return {"extinction_smooth": self.smooth * bends.square().mean()}

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        with torch.no_grad():
            return {} if query.camera is None else {"transmission": self.transmission(splats, query)[:, 0]}

    def effects(self) -> dict[str, dict[str, Any]]:
        beta = (self.log_depth.detach().clamp(*LOG_DEPTHS).exp() / self.typical.to(self.log_depth)).mean()
        return {"attenuation": {"per_unit": beta.item(), "moments": self.moments}}

    @torch.no_grad()
    def courses(self) -> list[Course]:
        if self.moments == 0:
            return []
        shares = torch.linspace(0, 1, 4 * (self.moments - 1) + 1, dtype=torch.float64)
        times = (self.clock.first_s + self.clock.span_s * shares).tolist()
        return [
            Course("extinction of the air", times, [self.extinction(t).item() for t in times], "per unit of length")
        ]

    @property
    def cost(self) -> int:
        return 16  # distance 7, exponential and root 6, mixing 3
