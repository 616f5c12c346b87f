"""What a surface emits more in one direction than in another: spherical harmonics on top of its state."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from heatsplat.geometry import spherical_harmonics
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Query, Seeds
from heatsplat.thermal.part import HeatPart
from heatsplat.thermal.view_harmonics import BASIS_COST, active_degree, spherical_harmonics_of


class ViewDependence(HeatPart):
    """Values plus harmonics of degree 1 and above of the direction of view (3DGS); the constant one is the state's.

    Tensor: "view_rest" [N, B - 1, 1], zero at the start.

    Args:
        sh_degree: of the harmonics, 1 to 3.
        sh_degree_interval: steps after which training adds the next degree; 0 trains all from the start.
        lr_rest: learning rate.

    Raises:
        ValueError: the degree is not 1 to 3.
    """

    def __init__(self, sh_degree: int = 2, sh_degree_interval: int = 1000, lr_rest: float = 1.25e-4) -> None:
        super().__init__()
        self.bands = spherical_harmonics.band_count(sh_degree)
        if sh_degree == 0:
            raise ValueError("view dependence of degree 0 is none: give a degree of 1 to 3, or leave the part out")
        self.sh_degree = self.active_degree = sh_degree
        self.sh_degree_interval, self.lr_rest = sh_degree_interval, lr_rest

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        return {"view_rest": PerGaussian(seeds.values.new_zeros(len(seeds.means), self.bands - 1, 1), self.lr_rest)}

    def on_step(self, step: int) -> None:
        self.active_degree = active_degree(step, self.sh_degree, self.sh_degree_interval)

    def forward(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        if self.active_degree == 0:
            return values
        nothing = splats.means.new_zeros(len(splats), 1, 1)
        rest = splats["view_rest"]
        return values + spherical_harmonics_of(nothing, rest, splats.means, query, self.active_degree)

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"view_dependence": {"degree": self.sh_degree}}

    @property
    def cost(self) -> int:
        return BASIS_COST[self.sh_degree] + self.bands - 1
