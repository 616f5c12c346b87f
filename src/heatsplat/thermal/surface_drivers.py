"""What a weather record drives surfaces by: air, sunlight, sky, wind and rain, each with the effects that are simulated."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from heatsplat.contracts import SceneError, Weather
from heatsplat.geometry.exposure import felt_directions
from heatsplat.physics.drivers import of_sky, of_sunlight, of_water
from heatsplat.physics.responses import driver_means
from heatsplat.physics.sky import law_for, sky_temperature_k
from heatsplat.physics.surfaces import Drivers
from heatsplat.physics.units import celsius, kelvin
from heatsplat.physics.walls import LEAST_K
from heatsplat.thermal.balance_options import BalanceOptions
from heatsplat.thermal.weather_drive import NO_CLOUDS

log = logging.getLogger(__name__)

STRONGER = 3.0  # times the wind of training from which on another weather is warned of
FAR_DEGREES = 5.0  # from the nearest sun whose shadows are known: three weeks of a year, or twenty minutes


class Contribution(NamedTuple):
    """What one part of the weather contributes.

    Args:
        drivers: fields of ``Drivers`` by name.
        effects: by name of the effect that is simulated, its settings with what was left out of it.
    """

    drivers: dict[str, Any] = {}
    effects: dict[str, dict[str, Any]] = {}


def drivers_of(
    weather: Weather,
    options: BalanceOptions,
    reference_k: float,
    mean_wind: float,
    ways: Tensor | None = None,
    moments_s: Sequence[float | None] = (),
) -> tuple[Drivers, dict[str, dict[str, Any]]]:
    """What drives surfaces in a weather, and the effects that are simulated with what was left out of them.

    Args:
        weather: a record with the temperature of the air.
        reference_k: temperature that drivers count from.
        mean_wind: of the record that the model was trained with in m/s; 0 without wind.
        ways: [D, 3] directions of the sun for which it is known what it reaches; None: those of this weather.
        moments_s: of images, for which such directions are chosen.

    Raises:
        SceneError: the record lacks what an option needs.
    """
    light = _sunlight(weather, options)
    up = light.drivers.get("up")
    contributions = (
        _air(weather, options, reference_k),
        _bodies(options, reference_k),
        light,
        _surroundings(weather, options, up, ways, moments_s),
        _sky(weather, options, reference_k, up),
        _wind(weather, options, mean_wind),
        _water(weather, options),
    )
    drivers: dict[str, Any] = {}
    effects: dict[str, dict[str, Any]] = {}
    for contribution in contributions:
        drivers |= contribution.drivers
        for name, settings in contribution.effects.items():
            effects.setdefault(name, {}).update(settings)
    return Drivers(weather.times_s, reference_k, **drivers), effects


def _air(weather: Weather, options: BalanceOptions, reference_k: float) -> Contribution:
    convection = {"air": "recorded"}
    if options.convection is not None:
        convection["given"] = "{:g} + {:g} v W/(m² K) in wind v".format(*options.convection)
    return Contribution({"air": kelvin(weather.air_c) - reference_k}, {"convection": convection})


def _bodies(options: BalanceOptions, reference_k: float) -> Contribution:
    """What lies behind surfaces, whatever the weather."""
    drivers: dict[str, Any] = {}
    effects: dict[str, dict[str, Any]] = {}
    if options.nodes == 2:
        effects["relaxation"] = {"nodes": "surface and core"}
    if options.semi_infinite:
        effects["semi_infinite"] = {"bodies": "without an end, about their mean"}
    if options.inner:
        warm = "constant" if options.indoor_c is None else f"of rooms at {options.indoor_c:g} °C"
        effects["convection"] = {"from_within": f"{warm}, q/H of each Gaussian"}
    if options.indoor_c is not None:
        air_c = celsius(reference_k)
        if abs(options.indoor_c - air_c) < LEAST_K:
            raise SceneError(
                f"indoor_c={options.indoor_c:g} is the mean temperature of the air outside ({air_c:.1f} °C) within "
                f"{LEAST_K:g} K: nothing then tells what walls let through; leave indoor_c out"
            )
        drivers["room"] = options.indoor_c - air_c
    return Contribution(drivers, effects)


def _sunlight(weather: Weather, options: BalanceOptions) -> Contribution:
    """Beams with the direction that is up where surfaces meet them as they lie, and the light of all but the beams."""
    if not options.sun:
        return Contribution()
    drivers = of_sunlight(weather, tilted=options.normals == "seen")
    if "beams" in drivers:
        return Contribution(drivers, {"solar": {"surfaces": "as seen", "sky": "isotropic"}})
    if not drivers:
        log.warning("the weather has no irradiance: nothing is heated by the sun")
        return Contribution(
            effects={"convection": {"left_out_sun": "sunlight, of which the weather has no irradiance"}}
        )
    solar = {"surfaces": "level"}
    if options.normals == "seen":
        solar["left_out"] = "the direction of the sun, which the weather lacks"
    return Contribution(drivers, {"solar": solar})


def _surroundings(
    weather: Weather, options: BalanceOptions, up: Tensor | None, ways: Tensor | None, moments_s: Sequence[float | None]
) -> Contribution:
    """What comes of the scene's own geometry: shadows, sky that is hidden, light from the ground."""
    if options.surrounded and up is None:
        raise SceneError(
            "shadows, sky_view and albedo need the direction of the sun with its direct and diffuse light, which the "
            "weather lacks; add them, or leave these effects out"
        )
    drivers: dict[str, Any] = {}
    effects: dict[str, dict[str, Any]] = {}
    if options.shadows:
        drivers["ways"] = felt_directions(weather, moments_s) if ways is None else ways
        shining = weather.sun[weather.direct_w_m2 > 0]
        cosine = float((shining @ drivers["ways"].T).amax(1).min()) if len(shining) else 1.0
        if cosine < math.cos(math.radians(FAR_DEGREES)):
            log.warning(
                "shadows are those of the sun where it stood during training, up to %.0f degrees from where this weather has it",
                math.degrees(math.acos(max(cosine, -1.0))),
            )
        effects["shadows"] = {"directions": len(drivers["ways"])}
    if options.sky_view:
        effects["sky_view"] = {"sky": "as far as it is open"}
    if options.albedo is not None:
        level = weather.direct_w_m2 * (weather.sun @ up).clamp(min=0.0) + weather.diffuse_w_m2
        drivers["ground"] = options.albedo * level / 1000.0
        effects["albedo"] = {"ground": options.albedo}
    return Contribution(drivers, effects)


def _sky(weather: Weather, options: BalanceOptions, reference_k: float, up: Tensor | None) -> Contribution:
    """Long waves of the sky, and of what surfaces that lean see in its place."""
    if options.sky is None:
        return Contribution()
    humid = weather.humidity_percent is not None
    law = law_for(options.sky, humid)
    if law != "swinbank" and not humid:
        raise SceneError(
            f"sky={law} needs humidity_percent, which the weather does not have; use sky=swinbank or sky=auto"
        )
    clouds = weather.clouds if options.clouds else 0.0
    if clouds is None:
        raise SceneError(f"the weather {NO_CLOUDS}")
    sky_k = sky_temperature_k(kelvin(weather.air_c), weather.humidity_percent, law, clouds)
    radiation = {"sky": law, "power": "about each mean" if options.linear else "T⁴"}
    if options.clouds:
        radiation["clouds"] = weather.notes.get("clouds", "recorded")
    if not humid:
        radiation["left_out"] = "humidity, which the weather lacks"
    return Contribution(of_sky(weather, sky_k, reference_k, tilted=up is not None), {"radiation": radiation})


def _wind(weather: Weather, options: BalanceOptions, mean_wind: float) -> Contribution:
    if not options.windy:
        return Contribution()
    if mean_wind > 0:
        if weather.wind_m_s is None:
            raise SceneError("the model was trained with wind, but this weather has no wind_m_s; add it")
        here = float(driver_means(weather.times_s, weather.wind_m_s))
        if here > STRONGER * mean_wind:
            log.warning(
                "this weather has %.3g m/s of wind in the mean, and training had %.3g: images did not tell what so much does, "
                "and surfaces follow the air as learned in less", here, mean_wind,
            )  # fmt: skip
        recorded = f"recorded, {mean_wind:.3g} m/s in the mean"
        return Contribution({"wind_anomaly": weather.wind_m_s / mean_wind - 1}, {"convection": {"wind": recorded}})
    blows = weather.wind_m_s is not None and bool((weather.wind_m_s > 0).any())
    lacks = "which the weather lacks" if weather.wind_m_s is None else "of which there was none in training"
    left_out = {"left_out": f"wind, {lacks}"}
    if blows:
        log.warning("the weather has wind, %s: surfaces stay as in still air", lacks)
    if options.convection is None:
        return Contribution(effects={"convection": left_out})
    if weather.wind_m_s is None:
        raise SceneError(f"exchange={options.exchange} needs wind_m_s, which the weather does not have")
    still = torch.zeros_like(weather.wind_m_s)
    told = left_out if blows else {"wind": "recorded, 0 m/s throughout"}
    return Contribution({"wind_anomaly": still}, {"convection": told})


def _water(weather: Weather, options: BalanceOptions) -> Contribution:
    """Water that evaporates from surfaces: of the record's rain, and of plants.

    Another weather, such as a forecast, often has no column of rain.
    """
    effects: dict[str, Any] = {}
    humid = weather.humidity_percent is not None
    holds_mm = None  # where no rain wets surfaces
    if options.transpires:
        if not humid:
            raise SceneError(
                "transpires=true needs humidity_percent, which the weather does not have; add it, or leave transpiration out"
            )
        effects["transpires"] = "a share of a wet surface's evaporation for each Gaussian"
    if options.rain is not None and (weather.rain_mm_h is None or not humid):
        log.warning("the weather has no rain_mm_h with humidity_percent: surfaces stay dry")
        effects["left_out_rain"] = "rain, of which the weather has no rain_mm_h, or no humidity_percent"
    elif options.rain is not None:
        times_s = weather.times_s
        fallen = float(driver_means(times_s, weather.rain_mm_h / 3600.0)) * float(times_s[-1] - times_s[0])
        effects["rain"] = f"{fallen:.3g} mm, of which surfaces hold up to {options.rain:g}"
        holds_mm = options.rain if fallen > 0 else None
    return Contribution(of_water(weather, holds_mm, options.transpires), {"convection": effects} if effects else {})
