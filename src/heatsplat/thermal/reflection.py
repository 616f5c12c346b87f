"""Surroundings that are seen in a surface as in a mirror."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData
from heatsplat.geometry import spherical_harmonics
from heatsplat.geometry.rotations import reflected
from heatsplat.same_bits import everywhere, sigmoid, weighted
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Query, Seeds, surface_normals
from heatsplat.thermal.part import HeatPart


class Reflection(HeatPart):
    """(1 - ρ) x + ρ L of what a surface emits: Kirchhoff's law for an opaque body (RaViGS, Eq. 5, with ρ = 1 - ε).

    The radiance L of the surroundings belongs to the scene: spherical harmonics of the direction in which the line of
    sight goes on after it met the surface, with its normal (``Query.normals``). At degree 0 it is one
    number (RaViGS), which a surface that never changes could as well emit itself.

    Tensor: "reflectance_logit" [N].

    Args:
        degree: of the harmonics of L, 0 to 2.
        reflectance: ρ at the start, in (0, 1).
        lr_reflectance: learning rate of its logit.
        lr, lr_end: of L, and the factor on it at the end of the run.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(
        self,
        degree: int = 2,
        reflectance: float = 0.05,
        lr_reflectance: float = 5e-3,
        lr: float = 1e-3,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__()
        if degree not in (0, 1, 2) or not 0 < reflectance < 1:
            raise ValueError(f"degree must be 0 to 2 and reflectance in (0, 1), got {degree} and {reflectance}")
        self.degree, self.reflectance = degree, reflectance
        self.lr_reflectance, self.lr, self.lr_end = lr_reflectance, lr, lr_end
        self.surroundings = nn.Parameter(torch.zeros(spherical_harmonics.band_count(degree)))

    def prepare(self, scene: SceneData) -> None:
        level = 0.5
        if scene.thermal_range is not None and scene.ambient_c is not None:
            level = scene.thermal_range.to_unit(scene.ambient_c)
        with torch.no_grad():
            self.surroundings[0] = level / spherical_harmonics.C0

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        logit = math.log(self.reflectance / (1 - self.reflectance))
        own = {"reflectance_logit": PerGaussian(seeds.values.new_full((len(seeds.means),), logit), self.lr_reflectance)}
        return own | surface_normals(seeds) if self.degree > 0 else own

    def forward(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        share = sigmoid(query.rows(splats["reflectance_logit"]))[:, None]
        return values + share * (self._radiance(values, splats, query) - values)

    def _radiance(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        """L where Gaussians with these values [n, 1] mirror it, [n, 1]."""
        if self.degree == 0:
            return everywhere(spherical_harmonics.C0 * self.surroundings, values)
        mirrored = reflected(query.sight(splats, "what a surface mirrors"), query.normals(splats))
        return weighted(spherical_harmonics.basis(mirrored, self.degree), self.surroundings)[:, None]

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        return {"reflectance": sigmoid(query.rows(splats["reflectance_logit"]))}

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"reflection": {"degree": self.degree}}

    @property
    def cost(self) -> int:
        return 6 + {0: 0, 1: 60, 2: 80}[self.degree]  # the formula; rotation, mirroring and harmonics
