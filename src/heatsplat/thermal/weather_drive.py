"""The weather at a moment, as a network sees it and as it drives a balance of heat."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from heatsplat.contracts import WEATHER_COLUMNS, SceneData, SceneError, Weather
from heatsplat.physics.sky import LAWS, sky_temperature_k
from heatsplat.physics.units import DAY_S, kelvin

SKIES = ("none", *LAWS)
NO_CLOUDS = (
    "tells no clouds, which clouds=true needs: add cloud_cover_percent, or irradiance with latitude and longitude, or give "
    "clouds=false for a clear sky"
)


def columns_at(weather: Weather, time_s: float) -> Tensor:
    """The five weather values at a moment, [5] float64 in the order of ``WEATHER_COLUMNS``; NaN where one is missing.

    **Convention:** wind as log(1 + wind in m/s), since most of it is weak; the others in their units.

    Raises:
        SceneError: the record does not reach the moment.
    """
    now = weather.at(time_s)
    values = {name: getattr(now, name) for name in WEATHER_COLUMNS}
    if values["wind_m_s"] is not None:
        values["wind_m_s"] = math.log1p(max(values["wind_m_s"], 0.0))
    return torch.tensor([math.nan if value is None else value for value in values.values()], dtype=torch.float64)


def remembered(weather: Weather, hours: Sequence[float]) -> Tensor:
    """What the record's columns (``columns_at``) were before each sample, [T, 5 hours] float64: means that forget as e^{-t/τ},
    for each τ in ``hours``. Before the record lies what its first day is on average."""
    columns = torch.stack([columns_at(weather, time) for time in weather.times_s.tolist()])
    before = columns[weather.times_s <= weather.times_s[0] + DAY_S].mean(0)
    found = []
    for tau_s in (3600.0 * hour for hour in hours):
        state, series = before, [before]
        for i, step in enumerate(weather.times_s.diff().tolist()):
            keep = math.exp(-step / tau_s)
            state = keep * state + (1.0 - keep) * 0.5 * (columns[i] + columns[i + 1])
            series.append(state)
        found.append(torch.stack(series))
    return torch.cat(found, 1) if found else columns[:, :0]


def sunlight_at(weather: Weather, time_s: float) -> list[tuple[Tensor, float]]:
    """Beams of sunlight at a moment: direction towards the source [3] in the world, and W/m² on a surface facing it.

    With the sun's direction and direct irradiance known: the sun, and the sky's light from straight above where the
    record has it. Otherwise all light comes from straight above, as strong as on a horizontal surface. At night, and
    without any irradiance, there is none.
    """
    beams = []
    if weather.sun is not None and weather.direct_w_m2 is not None:
        towards = value_at(weather, weather.sun, time_s)
        length = float(towards.norm())  # of the chord between two directions; zero only where they are opposite
        if length > 0:
            beams.append((towards / length, float(value_at(weather, weather.direct_w_m2, time_s))))
        if weather.diffuse_w_m2 is not None:
            beams.append((weather.up, float(value_at(weather, weather.diffuse_w_m2, time_s))))
    elif weather.irradiance_w_m2 is not None:
        beams.append((weather.up, float(value_at(weather, weather.irradiance_w_m2, time_s))))
    return [(direction, power) for direction, power in beams if power > 0]


def source_of_sunlight(weather: Weather) -> str:
    """Which irradiance ``sunlight_at`` uses, in words for reports."""
    if weather.sun is not None and weather.direct_w_m2 is not None:
        return "direct, from the sun" + (", and diffuse, from above" if weather.diffuse_w_m2 is not None else "")
    if weather.irradiance_w_m2 is not None:
        return "horizontal, from above: the record has no direction of the sun or no direct irradiance"
    return "none: the record has no irradiance"


def check_weather(scene: SceneData, sky: str) -> None:
    """Raises SceneError, with the way out, where the scene's weather lacks what a balance under this sky needs."""
    if scene.weather.air_c is None:
        raise SceneError(
            f"the weather of scene '{scene.name}' has no air temperature, without which nothing is known of how air "
            "cools: add air_c, or leave the balance out with thermal.weights.ode=0 thermal.weights.pinn=0"
        )
    if sky not in ("none", "swinbank") and scene.weather.humidity_percent is None:
        raise SceneError(
            f"the weather of scene '{scene.name}' has no humidity, which thermal.sky={sky} needs; "
            "thermal.sky=swinbank does without"
        )


def sky_at(weather: Weather, time_s: float, sky: str) -> float:
    """Temperature in kelvin of what a body sees above it at a moment; 0 under no sky."""
    if sky == "none":
        return 0.0
    now = weather.at(time_s)
    moist = None if now.humidity_percent is None else torch.tensor(now.humidity_percent, dtype=torch.float64)
    return float(sky_temperature_k(kelvin(torch.tensor(now.air_c, dtype=torch.float64)), moist, sky))


def value_at(weather: Weather, series: Tensor, time_s: float) -> Tensor:
    """A series at a moment within the record, linear between samples."""
    after, share = weather.between(time_s)
    return series[after - 1] * (1 - share) + series[after] * share
