"""Density control that leaves the Gaussians as they are."""

from __future__ import annotations

from heatsplat.density.base import DensityControl
from heatsplat.splats import ANCHORS, GAUSSIANS, NOTHING


class Fixed(DensityControl):
    """No Gaussian is added or removed; no statistic is kept."""

    rows = frozenset({GAUSSIANS, ANCHORS, NOTHING})
