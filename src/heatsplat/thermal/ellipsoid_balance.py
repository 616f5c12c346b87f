"""The balance of heat of Gaussians that are solid ellipsoids under sun, air and sky (ThermoGS, Eq. 2-9)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import SceneData, Weather, check_option
from heatsplat.geometry.rotations import quats_to_matrices
from heatsplat.physics.ellipsoids import (
    PROJECTED_AREAS,
    SURFACE_AREAS,
    convecting_area_ratio,
    floored_axes,
    projected_area_ratio,
    radiating_area_ratio,
)
from heatsplat.physics.heat_flow import heating_rate
from heatsplat.physics.units import kelvin
from heatsplat.splats import Splats
from heatsplat.thermal.base import PerGaussian, Seeds
from heatsplat.thermal.weather_drive import SKIES, check_weather, sky_at, source_of_sunlight, sunlight_at


class EllipsoidBalance:
    """dT/dt of ellipsoids whose sunlit area, radiating area and convecting area are those of the Gaussians.

    Args:
        projected_area: "exact" or "printed" (Eq. 8), the area that sunlight falls on.
        surface_area: "printed" (Eq. 6) or "consistent", the area that air cools.
        sky: "none" lets bodies radiate into empty space (paper); a law of ``physics.sky`` gives them a clear sky.
        smallest_axis_m: axes count as at least this.

    Raises:
        ValueError: an option is unknown.
    """

    def __init__(self, projected_area: str, surface_area: str, sky: str, smallest_axis_m: float) -> None:
        check_option("projected_area", projected_area, PROJECTED_AREAS)
        check_option("surface_area", surface_area, SURFACE_AREAS)
        check_option("sky", sky, SKIES)
        self.projected_area, self.surface_area = projected_area, surface_area
        self.sky, self.smallest_axis_m = sky, smallest_axis_m

    def check(self, scene: SceneData) -> None:
        """Raises SceneError, with the way out, where the scene's weather lacks what the balance needs."""
        check_weather(scene, self.sky)

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        """Tensors of Gaussians that the balance needs of its own: none."""
        return {}

    @torch.no_grad()
    def areas(self, splats: Splats, ids: Tensor, metres_per_unit: float) -> dict[str, Tensor]:
        """Areas over volumes in 1/m, the axes themselves [n, 3] and their directions [n, 3, 3]."""
        axes = floored_axes(splats.scales[ids], metres_per_unit, self.smallest_axis_m)
        return {
            "axes": axes,
            "rotations": quats_to_matrices(splats.quats[ids]),
            "radiating": radiating_area_ratio(axes),
            "convecting": convecting_area_ratio(axes, self.surface_area),
        }

    def rate(
        self, temperature_k: Tensor, body: dict[str, Tensor], areas: dict[str, Tensor], weather: Weather, time_s: float
    ) -> Tensor:
        """dT/dt in K/s at temperatures [n], a moment and its weather.

        Args:
            body: attributes by name (``land_cover.ATTRIBUTES``), each [n].
            areas: of ``areas``.
        """
        lit = 0.0
        for direction, power in sunlight_at(weather, time_s):
            local = direction.to(areas["rotations"]) @ areas["rotations"]
            lit = lit + power * projected_area_ratio(areas["axes"], local, self.projected_area)
        air_k = kelvin(torch.tensor(weather.at(time_s).air_c, dtype=torch.float64))
        return heating_rate(
            temperature_k,
            absorbed_w_m3=body["absorptivity"] * lit,
            emissivity=body["emissivity"],
            convection=body["convection"],
            capacity=body["capacity"],
            radiating_ratio=areas["radiating"],
            convecting_ratio=areas["convecting"],
            air_k=float(air_k),
            sky_k=sky_at(weather, time_s, self.sky),
        )

    def effects(self, weather: Weather | None) -> dict[str, dict[str, Any]]:
        """The effects that it simulates: catalogue name -> settings."""
        effects = {"radiation": {"sky": self.sky}, "convection": {"surface_area": self.surface_area}}
        if weather is not None:
            effects["solar"] = {"projected_area": self.projected_area, "irradiance": source_of_sunlight(weather)}
        return effects
