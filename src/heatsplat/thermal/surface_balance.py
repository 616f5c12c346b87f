"""The balance of heat of surfaces: slabs of one thickness that take light, long waves and air at their front alone."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import SceneData, Weather, check_option
from heatsplat.physics.heat_flow import heating_rate
from heatsplat.physics.units import kelvin
from heatsplat.splats import Splats
from heatsplat.thermal.base import NORMALS, PerGaussian, Seeds, surface_normals
from heatsplat.thermal.weather_drive import SKIES, check_weather, sky_at, source_of_sunlight, sunlight_at


class SurfaceBalance:
    """dT/dt of slabs that face as the surfaces do that Gaussians show.

    A slab that leans sees as much of its surroundings, at the temperature of the air, as it sees less of the sky.

    Args:
        sky: "none" lets slabs radiate into empty space; a law of ``physics.sky`` gives them a clear sky.
        depth_m: their thickness.

    Raises:
        ValueError: an option is unknown or out of its range.
    """

    def __init__(self, sky: str, depth_m: float) -> None:
        check_option("sky", sky, SKIES)
        if depth_m <= 0:
            raise ValueError(f"depth_m must be positive, got {depth_m}")
        self.sky, self.depth_m = sky, depth_m

    def check(self, scene: SceneData) -> None:
        """Raises SceneError, with the way out, where the scene's weather lacks what the balance needs."""
        check_weather(scene, self.sky)

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        """Tensors of Gaussians that the balance needs of its own: the normals of surfaces."""
        return surface_normals(seeds)

    @torch.no_grad()
    def areas(self, splats: Splats, ids: Tensor, metres_per_unit: float) -> dict[str, Tensor]:
        """Unit normals [n, 3]; a slab has no other shape."""
        return {"normals": splats[NORMALS][ids]}

    def rate(
        self, temperature_k: Tensor, body: dict[str, Tensor], areas: dict[str, Tensor], weather: Weather, time_s: float
    ) -> Tensor:
        """As ``EllipsoidBalance.rate``."""
        normals = areas["normals"]
        above = 0.5 * (1.0 + normals @ weather.up.to(normals)).clamp(max=2.0)  # more by rounding
        lit = torch.zeros_like(above)
        for direction, power in sunlight_at(weather, time_s):
            diffuse = direction is weather.up
            lit = lit + power * (above if diffuse else (normals @ direction.to(normals)).clamp(min=0.0))
        air_k = float(kelvin(torch.tensor(weather.at(time_s).air_c, dtype=torch.float64)))
        sky_k = sky_at(weather, time_s, self.sky)
        around_k = (above * sky_k**4 + (1.0 - above) * air_k**4) ** 0.25
        return heating_rate(
            temperature_k,
            absorbed_w_m3=body["absorptivity"] * lit / self.depth_m,
            emissivity=body["emissivity"],
            convection=body["convection"],
            capacity=body["capacity"],
            radiating_ratio=torch.full_like(lit, 1.0 / self.depth_m),
            convecting_ratio=torch.full_like(lit, 1.0 / self.depth_m),
            air_k=air_k,
            sky_k=around_k,
        )

    def effects(self, weather: Weather | None) -> dict[str, dict[str, Any]]:
        """The effects that it simulates: catalogue name -> settings."""
        effects = {"radiation": {"sky": self.sky}, "convection": {"body": "surface", "depth_m": self.depth_m}}
        if weather is not None:
            effects["solar"] = {"irradiance": source_of_sunlight(weather)}
        return effects
