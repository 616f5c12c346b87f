"""Areas of ellipsoids over their volumes, for heat balances of Gaussians (ThermoGS, Eq. 6-9).

Area and volume are never formed apart: the volume of a small splat underflows, the ratio does not. Every ratio is a
function of the inverse semi-axes alone, and thin directions dominate it.

**Convention:** semi-axes [..., 3] in metres and positive, ratios [...] in 1/m. Directions [..., 3] are unit vectors in the
axes of the ellipsoid, so that component i belongs to semi-axis i.
"""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.contracts import check_option

SMALLEST_AXIS_M = 0.01  # heat goes this deep at least; a splat's own thin axis is fitted to images, not to heat
THOMSEN_POWER = 1.6075  # Knud Thomsen's exponent: error of the area below 1.061 % for any axes (the paper writes 1.61)
SURFACE_AREAS = ("consistent", "printed")
PROJECTED_AREAS = ("exact", "printed")


def floored_axes(scales: Tensor, metres_per_unit: float, smallest_m: float = SMALLEST_AXIS_M) -> Tensor:
    """Semi-axes in metres, at least ``smallest_m``, of semi-axes [..., 3] in world units.

    Raises:
        ValueError: a factor is not positive.
    """
    if not (metres_per_unit > 0 and smallest_m > 0):
        raise ValueError(f"metres_per_unit and smallest_m must be positive, got {metres_per_unit} and {smallest_m}")
    return (scales * metres_per_unit).clamp(min=smallest_m)


def radiating_area_ratio(axes: Tensor) -> Tensor:
    """Whole surface over volume, 3 [((ab)^p + (ac)^p + (bc)^p) / 3]^{1/p} / (abc): the area that radiates (Eq. 7).

    Knud Thomsen's formula; 3/r for a sphere. It is the p-mean of the inverse semi-axes, times three.
    """
    inverse = axes.reciprocal()
    largest = inverse.amax(-1, keepdim=True)  # divided out first: powers of inverse micrometres would overflow
    mean = ((inverse / largest) ** THOMSEN_POWER).mean(-1) ** (1 / THOMSEN_POWER)
    return 3 * largest.squeeze(-1) * mean


def convecting_area_ratio(axes: Tensor, surface_area: str = "consistent") -> Tensor:
    """Area that exchanges heat with the air, over volume.

    Args:
        surface_area: "consistent" is the whole surface, the one that radiates. "printed" is Eq. 6, (π/3)(ab + ac + bc),
            which for a sphere is π r² and not 4 π r²: a quarter of the surface.

    Raises:
        ValueError: the option is unknown.
    """
    check_option("surface_area", surface_area, SURFACE_AREAS)
    if surface_area == "consistent":
        return radiating_area_ratio(axes)
    return axes.reciprocal().sum(-1) / 4


def projected_area_ratio(axes: Tensor, directions: Tensor, projected_area: str = "exact") -> Tensor:
    """Area that the ellipsoid shows towards a direction, over volume: the area that sunlight falls on.

    Args:
        projected_area: "exact" is the shadow, π √((bc d_x)² + (ac d_y)² + (ab d_z)²). "printed" is Eq. 8,
            π abc / √((a d_x)² + (b d_y)² + (c d_z)²), the central section across the direction. They agree along the
            principal axes; of a disc with c = a/100 seen at 45° the section is 2 % of the shadow.

    Raises:
        ValueError: the option is unknown.
    """
    check_option("projected_area", projected_area, PROJECTED_AREAS)
    if projected_area == "exact":
        return 0.75 * _length(directions / axes)
    return 0.75 / _length(directions * axes)


def _length(vectors: Tensor) -> Tensor:
    """Euclidean length [...] of vectors [..., 3]; the largest component first, so that no square overflows or vanishes."""
    largest = vectors.detach().abs().amax(-1, keepdim=True)
    scale = torch.where(largest > 0, largest, 1.0)
    return torch.linalg.vector_norm(vectors / scale, dim=-1) * scale.squeeze(-1)
