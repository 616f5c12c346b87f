"""What a surface does not emit towards its sides, and mirrors of the surroundings in its place."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData, check_count
from heatsplat.same_bits import everywhere, sigmoid
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Query, Seeds, surface_normals
from heatsplat.thermal.part import HeatPart

SHORTEST = 1e-6  # of a normal with its tilt, whose direction counts as one


class DirectionalEmissivity(HeatPart):
    """x + s (1 - cos θ)^p (A - x) of what a surface emits at the angle θ between line of sight and normal.

    All surfaces share the falloff s. What a surface emits less than along its normal it mirrors of the surroundings
    (Kirchhoff's law), which are as warm as the ambient temperature A where that was measured; else A is learned. With p = 5 it
    is the emissivity of smooth dielectrics (Schlick's approximation of Fresnel's equations), with p = 1 that of rough surfaces.
    Heat refines the normals: each Gaussian learns by how much its own departs from that of the surface (``Query.normals``).

    Tensor: "normal_tilt" [N, 3], added to the normal before that is normalised, zero at the start; none at a rate of 0.

    Args:
        falloff: s at the start, in (0, 1).
        power: p, a whole number of at least 1.
        lr_tilt: learning rate of tilts; 0 leaves normals as they are.
        lr, lr_end: learning rate of s's logit and of A, and the factor on it at the end of the run.

    Raises:
        ValueError: an option is out of its range.
    """

    beyond_record = "surfaces emit as within the record"

    def __init__(
        self,
        falloff: float = 0.3,
        power: int = 5,
        lr_tilt: float = 5e-3,
        lr: float = 0.01,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__()
        check_count("power", power)
        if not 0 < falloff < 1:
            raise ValueError(f"falloff must be in (0, 1), got {falloff}")
        self.power, self.lr_tilt, self.lr, self.lr_end = power, lr_tilt, lr, lr_end
        self.falloff_logit = nn.Parameter(torch.logit(torch.tensor(falloff)))
        self.register_buffer("level", torch.tensor(0.5))

    def prepare(self, scene: SceneData) -> None:
        self.know_surroundings(scene)

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        tilts = {"normal_tilt": PerGaussian(torch.zeros_like(seeds.means), self.lr_tilt)} if self.lr_tilt > 0 else {}
        return surface_normals(seeds) | tilts

    def forward(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        return values + self.mirrored(splats, query) * (everywhere(self.level, values) - values)

    def mirrored(self, splats: Splats, query: Query) -> Tensor:
        """s (1 - cos θ)^p, [n, 1]."""
        sight = query.sight(splats, "how much a surface emits")
        normals = query.normals(splats)
        if self.lr_tilt > 0:
            normals = normals + query.rows(splats["normal_tilt"])
            normals = normals / normals.square().sum(1, keepdim=True).clamp(min=SHORTEST**2).sqrt()
        facing = (sight * normals).sum(1, keepdim=True).abs().clamp(max=1.0)
        slant = math.prod([1.0 - facing] * self.power)  # torch's power has other bits on another number of threads
        return everywhere(sigmoid(self.falloff_logit), slant) * slant

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        return {} if query.camera is None else {"relative_emissivity": 1.0 - self.mirrored(splats, query)[:, 0]}

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"directional_emissivity": {"falloff": torch.sigmoid(self.falloff_logit).item(), "power": self.power}}

    @property
    def cost(self) -> int:
        return 16 + (12 if self.lr_tilt > 0 else 0)  # direction 9, angle 4, mixing 3; tilt
