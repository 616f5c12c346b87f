"""The sky that a surface outdoors mirrors to the camera, in place of what it does not emit itself."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import SceneData, SceneError, Weather, check_option
from heatsplat.geometry.rotations import reflected
from heatsplat.physics import sky
from heatsplat.physics.units import kelvin
from heatsplat.same_bits import sigmoid
from heatsplat.splats import Splats
from heatsplat.thermal.base import SKY_SEEN, PerGaussian, Query, Seeds, surface_normals
from heatsplat.thermal.coordinates import ImageRange
from heatsplat.thermal.part import HeatPart
from heatsplat.thermal.weather_drive import NO_CLOUDS


class MirroredSky(HeatPart):
    """T⁴ becomes (1 - ρ) T⁴ + ρ L: Kirchhoff's law for an opaque body under the sky of the weather record.

    L is that of the direction in which the line of sight goes on after it met the surface: air of the optical depth that gives
    the hemisphere the sky's long waves, seen through its slant; so the zenith is coldest. What is no sky is as warm as the air:
    directions below the horizon, and what stands in the way where a model asks for it (``SKY_SEEN``).

    Tensor: "sky_reflectance_logit" [N], of ρ.

    Args:
        law, clouds: of the sky's temperature; see ``EnergyBalance``.
        reflectance: ρ at the start, in (0, 1).
        lr_reflectance: learning rate of its logit.

    Raises:
        ValueError: an option is out of its range.
    """

    needs = frozenset({"time", "weather", "thermal_range"})

    def __init__(
        self, law: str = "auto", clouds: bool = False, reflectance: float = 0.08, lr_reflectance: float = 5e-3
    ) -> None:
        super().__init__()
        check_option("law", law, ("auto", *sky.LAWS))
        if not 0 < reflectance < 1:
            raise ValueError(f"reflectance must lie in (0, 1), got {reflectance}")
        self.law, self.clouds, self.reflectance, self.lr_reflectance = law, clouds, reflectance, lr_reflectance
        self.range = ImageRange()
        self._weather: Weather | None = None

    def prepare(self, scene: SceneData) -> None:
        if scene.weather.air_c is None:
            raise SceneError(f"the weather of scene '{scene.name}' has no air_c, the temperature of the air; add it")
        if self.clouds and scene.weather.clouds is None:
            raise SceneError(f"the weather of scene '{scene.name}' {NO_CLOUDS}")
        self.range.prepare(scene)
        self._weather = scene.weather

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        logit = math.log(self.reflectance / (1 - self.reflectance))
        start = seeds.values.new_full((len(seeds.means),), logit)
        return {"sky_reflectance_logit": PerGaussian(start, self.lr_reflectance)} | surface_normals(seeds)

    def forward(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        own = self.range.kelvin(values) / 100.0  # of which powers are of order 100
        share = sigmoid(query.rows(splats["sky_reflectance_logit"]))[:, None]
        mirrored = (1 - share) * own.square().square() + share * self._radiance(splats, query)[:, None]
        shown = 100.0 * mirrored.clamp(min=1e-3).sqrt().sqrt()
        return (shown - self.range.lowest_k) / self.range.bounds.span_k

    def _radiance(self, splats: Splats, query: Query) -> Tensor:
        """L of what the Gaussians in ``query.ids`` mirror, [n], as T⁴ in units of (100 K)⁴."""
        mirrored = reflected(query.sight(splats, "what a surface mirrors"), query.normals(splats))
        sine = mirrored @ self._weather.up.to(mirrored)
        air_k, depth = self._air(query.time_s)
        emissivity = sky.emissivity_towards(depth, sine)
        if SKY_SEEN in splats:
            emissivity = 1 - query.rows(splats[SKY_SEEN].detach()) * (1 - emissivity)
        return (air_k / 100.0) ** 4 * emissivity

    def _air(self, time_s: float) -> tuple[float, Tensor]:
        """Temperature of the air in kelvin and its optical depth to the zenith."""
        now = self._weather.at(time_s)
        humid = now.humidity_percent is not None
        law = sky.law_for(self.law, humid)
        air_k = torch.tensor(kelvin(now.air_c), dtype=torch.float64)
        humidity = torch.tensor(now.humidity_percent, dtype=torch.float64) if humid else None
        closed = 0.0
        if self.clouds:
            closed = float(np.interp(time_s, self._weather.times_s.numpy(), self._weather.clouds.numpy()))
        emissivity = (sky.sky_temperature_k(air_k, humidity, law, closed) / air_k) ** 4
        return float(air_k), sky.optical_depth(emissivity)

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        return {"sky_reflectance": sigmoid(query.rows(splats["sky_reflectance_logit"]))}

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"mirrored_sky": {"law": self.law} | ({"clouds": "recorded"} if self.clouds else {})}

    @property
    def cost(self) -> int:
        return 60  # mirroring, an exponential and two powers
