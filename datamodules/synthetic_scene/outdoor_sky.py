"""The sky over the yard: its weather, made up from a few numbers and slow waves, and what that does to faces.

The sky's long waves follow air temperature and humidity; sun and sky are split as a measured irradiance would be.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import SceneError, Weather
from heatsplat.datamodules.sun import Site, clear_sky, clouds, cover_of, light_taken, split_irradiance, sun_directions
from heatsplat.datamodules.synthetic_scene.outdoor_heat import Forcing
from heatsplat.physics.units import DAY_S, KELVIN_AT_0_C, STEFAN_BOLTZMANN
from heatsplat.training.rng import generator_for

SITE = Site(latitude=47.0, longitude=9.0, altitude_m=500.0)
START_UTC_S = 1720656000.0  # 2024-07-11, 0:00 UTC
DURATION_S = 2.0 * DAY_S
SAMPLE_S = 600.0


@dataclass(frozen=True)
class Sky:
    """How the days go.

    Args:
        warm_c, swing_k: mean and half the range of the day's air temperature.
        dew_point_c: moisture of the air.
        cloud: added to the share of the sky that clouds take; -1 clears it, 1 closes it.
        wind_factor, wind_added: what becomes of the wind, in m/s.
    """

    warm_c: float = 18.0
    swing_k: float = 6.5
    dew_point_c: float = 9.5
    cloud: float = 0.0
    wind_factor: float = 1.0
    wind_added: float = 0.0


# "fair" is the weather of the record; the others are asked for with data.weather, and start from the same midnight.
SKIES: dict[str, Sky] = {
    "fair": Sky(),
    "calm": Sky(wind_factor=0.12),
    "windy": Sky(wind_added=7.0),
    "overcast": Sky(warm_c=15.5, swing_k=2.5, dew_point_c=11.5, cloud=2.2),
}


@cache  # a scene asks for it several times
def outdoor_weather(name: str, start_s: float = 0.0, end_s: float = DURATION_S) -> Weather:
    """The weather of a sky in ``SKIES`` every ten minutes, on the clock of the record; the same bits on every call.

    Another sky than "fair" takes over from it within the first hour of the record, so that all begin alike.

    Breeze and clouds are sums of slow waves of random phase. Clouds of cover c let 1 - 0.75 c^3.4 of the clear sky's
    light pass (Kasten and Czeplak 1980); what passes is split into sun and sky as a measured irradiance would be.

    Raises:
        SceneError: there is no such sky.
    """
    if name not in SKIES:
        raise SceneError(f"data.weather={name}: this scene knows {', '.join(SKIES)}")
    times = np.arange(start_s, end_s + 0.5 * SAMPLE_S, SAMPLE_S)
    air, wind, humidity, passing = _under(name, times)
    utc_s = START_UTC_S + times
    irradiance = clear_sky(SITE, utc_s) * passing
    direct, diffuse = split_irradiance(SITE, utc_s, irradiance)
    return Weather(
        times_s=torch.from_numpy(times),
        air_c=torch.from_numpy(air),
        wind_m_s=torch.from_numpy(wind),
        humidity_percent=torch.from_numpy(humidity),
        irradiance_w_m2=torch.from_numpy(irradiance),
        pressure_hpa=torch.from_numpy(955.0 + 4.0 * _drift("pressure", times, (53.0, 23.0))),
        direct_w_m2=torch.from_numpy(direct),
        diffuse_w_m2=torch.from_numpy(diffuse),
        clouds=clouds_of_light(utc_s, irradiance),
        sun=torch.from_numpy(sun_directions(SITE, utc_s)),
        notes={
            "source": f"made up: {name}",
            "latitude": SITE.latitude,
            "longitude": SITE.longitude,
            "altitude_m": SITE.altitude_m,
            "up": list(SITE.up),
            "north": list(SITE.north),
            "utc_at_zero_s": START_UTC_S,
        },
    )


def cloud_cover(name: str, times_s: np.ndarray) -> np.ndarray:
    """Share of the sky [T] that clouds of a sky in ``SKIES`` take, by night too."""
    return cover_of(1.0 - _under(name, times_s)[3])


def clouds_of_light(utc_s: np.ndarray, irradiance_w_m2: np.ndarray) -> Tensor | None:
    """What a record of this light tells of clouds (``Weather.clouds``)."""
    taken = clouds(SITE, utc_s, irradiance_w_m2)
    return None if taken is None else torch.from_numpy(taken)


def _under(name: str, times_s: np.ndarray) -> tuple[np.ndarray, ...]:
    """``series`` of a sky in ``SKIES``, which takes over from "fair" within the first hour of the record."""
    fair = series(SKIES["fair"], times_s)
    if name == "fair":
        return fair
    share = np.clip(times_s / 3600.0, 0.0, 1.0)
    return tuple(one + share * (other - one) for one, other in zip(fair, series(SKIES[name], times_s), strict=True))


def part_of(weather: Weather, part_s: tuple[float, float]) -> Weather:
    """The samples of a record between two times in seconds, and one more on either side."""
    kept = (weather.times_s >= part_s[0] - SAMPLE_S) & (weather.times_s <= part_s[1] + SAMPLE_S)
    known = {name: value for name, value in vars(weather).items() if name not in ("up", "notes") and value is not None}
    return replace(weather, **{name: value[kept] for name, value in known.items()})


def _drift(purpose: str, times_s: np.ndarray, periods_h: tuple[float, ...]) -> np.ndarray:
    """Slow waves [T] of random phase, their mean, in [-1, 1]."""
    phases = torch.rand(len(periods_h), generator=generator_for(0, 0, f"outdoor {purpose}"), dtype=torch.float64)
    periods = zip(periods_h, phases.tolist(), strict=True)
    return np.mean([np.sin(2.0 * np.pi * (times_s / 3600.0 / period + phase)) for period, phase in periods], axis=0)


def series(sky: Sky, times_s: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Air in °C, wind in m/s, humidity in % and the share of light that clouds let pass, each [T]."""
    solar_hours = times_s / 3600.0 + SITE.longitude / 15.0

    def drift(purpose: str, periods_h: tuple[float, ...]) -> np.ndarray:
        return _drift(purpose, times_s, periods_h)

    day = np.cos(2.0 * np.pi * (solar_hours - 15.0) / 24.0)
    second_harmonic = 0.15 * np.cos(4.0 * np.pi * (solar_hours - 14.0) / 24.0)
    air = sky.warm_c + sky.swing_k * (day + second_harmonic) + 1.2 * drift("air", (31.0, 9.0, 3.7)) + times_s / DAY_S
    dew_point = sky.dew_point_c + 1.5 * drift("moisture", (40.0, 11.0))
    humidity = np.clip(100.0 * _vapour_hpa(dew_point) / _vapour_hpa(air), 5.0, 100.0)
    wind_m_s = (
        2.6 + 1.1 * np.cos(2.0 * np.pi * (solar_hours - 16.0) / 24.0) + 2.2 * drift("wind", (17.0, 5.3, 1.9, 0.7))
    )
    wind = np.clip(wind_m_s, 0.2, None) * sky.wind_factor + sky.wind_added * (1.0 + 0.3 * drift("gusts", (6.1, 1.3)))
    cover = np.clip(0.25 + 1.3 * drift("clouds", (19.0, 5.9, 1.1, 0.43)) + sky.cloud, 0.0, 1.0)
    return air, wind, humidity, 1.0 - light_taken(cover)


def _vapour_hpa(celsius: np.ndarray) -> np.ndarray:
    """Saturation pressure of water vapour (Magnus; Alduchov and Eskridge 1996)."""
    return 6.1094 * np.exp(17.625 * celsius / (celsius + 243.04))


def sky_long_waves(weather: Weather) -> np.ndarray:
    """Long-wave irradiance [T] of a whole clear sky in W/m²: Brutsaert's emissivity 1.24 (e / T)^(1/7), e in hPa."""
    air_k = weather.air_c.numpy() + KELVIN_AT_0_C
    vapour = 0.01 * weather.humidity_percent.numpy() * _vapour_hpa(weather.air_c.numpy())
    return 1.24 * (vapour / air_k) ** (1.0 / 7.0) * STEFAN_BOLTZMANN * air_k**4


def forcing_of(weather: Weather, normals: np.ndarray) -> Forcing:
    """What a weather does to faces with outward ``normals`` [F, 3]; sun and sky are as bright all over (isotropic)."""
    air_k = weather.air_c.numpy() + KELVIN_AT_0_C
    sky_share = 0.5 * (1.0 + normals @ weather.up.numpy())
    beam = weather.direct_w_m2.numpy()[:, None] * np.clip(weather.sun.numpy() @ normals.T, 0.0, None)
    around = STEFAN_BOLTZMANN * air_k**4
    return Forcing(
        times_s=weather.times_s.numpy(),
        air_k=air_k,
        wind_m_s=weather.wind_m_s.numpy(),
        sunlight_w_m2=beam + weather.diffuse_w_m2.numpy()[:, None] * sky_share,
        long_waves_w_m2=sky_long_waves(weather)[:, None] * sky_share + around[:, None] * (1.0 - sky_share),
    )
