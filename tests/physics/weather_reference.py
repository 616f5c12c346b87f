"""A real-looking record of weather, and the heat balance solved by a stiff solver at tight tolerances."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.integrate import odeint

from heatsplat.contracts import Weather
from heatsplat.kernels.heat_balance import COVERS_MM
from heatsplat.physics.sky import sky_temperature_k
from heatsplat.physics.surfaces import Drivers, Surface, power_excess
from heatsplat.physics.wetness import drying_mm_s_k, vapour_k
from heatsplat.training.rng import generator_for

UP = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)


def drivers(days: float = 2.0, step_s: float = 600.0, wind: bool = True) -> Drivers:
    """Sun over 48° north with broken clouds that change between samples, gusty wind, and the sky by its humidity."""
    generator = generator_for(0, 0, "weather")
    times = torch.arange(0, days * 86400 + 1, step_s, dtype=torch.float64)
    hours, count = times / 3600, len(times)
    noise = torch.randn(count, generator=generator, dtype=torch.float64)
    drift = torch.zeros_like(noise)
    for k in range(1, count):
        drift[k] = 0.9 * drift[k - 1] + 0.44 * noise[k]
    air = 291.0 + 7.0 * torch.sin(2 * math.pi * (hours - 9) / 24) + 0.4 * drift
    latitude, declination, hour = math.radians(48), math.radians(15), 2 * math.pi * (hours - 12) / 24
    height = math.sin(latitude) * math.sin(declination) + math.cos(latitude) * math.cos(declination) * hour.cos()
    north = math.cos(latitude) * math.sin(declination) - math.sin(latitude) * math.cos(declination) * hour.cos()
    sun = torch.stack((-math.cos(declination) * hour.sin(), north, height), dim=1)
    clouds = 0.85 * (torch.randn(count, generator=generator, dtype=torch.float64) > 0.6)
    direct = torch.where(height > 0, torch.exp(-0.14 / height.clamp(min=0.05)), 0.0) * (1 - clouds)
    diffuse = 0.1 * height.clamp(min=0).sqrt() * (1 + clouds)
    reference = float(air.mean())
    sky = sky_temperature_k(air, torch.full_like(air, 60.0), "brutsaert")
    wind_m_s = (3 + 1.5 * drift).clamp(min=0)
    return Drivers(
        times,
        reference,
        air - reference,
        power_excess(sky - reference, reference),
        power_excess(air - reference, reference),
        diffuse,
        direct[:, None] * sun,
        wind_m_s / wind_m_s.mean() - 1 if wind else None,
        UP,
    )


def showers(given: Drivers) -> Drivers:
    """The record with two showers in air of which the humidity is known."""
    rain = torch.zeros_like(given.times_s)
    rain[30:34], rain[150:170] = 2.0 / 3600, 0.5 / 3600
    vapour = vapour_k(given.reference_k + given.air, torch.full_like(given.air, 60.0))
    return replace(given, vapour=vapour, rain=rain, dries=drying_mm_s_k(Weather(given.times_s)), holds_mm=0.3)


def solved(
    given: Drivers, surface: Surface, moments: torch.Tensor, about: torch.Tensor | None = None, atol: float = 1e-8
) -> torch.Tensor:
    """Temperatures x [n, F] of surfaces with normals, what is behind them and the water on them, at moments [F] by LSODA, one
    interval of the record at a time.

    Args:
        about: temperatures [n] about which T⁴ and wind are linearised; None solves the full balance.
        atol: of the solver, in kelvin and mm.
    """
    reference, times = given.reference_k, given.times_s.numpy()
    rate, share, sun = surface.log_rate.exp().numpy(), surface.share.numpy(), surface.sun.numpy()
    wind = surface.wind.numpy() if surface.wind is not None else 0.0
    view = ((1 + surface.normals @ UP) / 2).numpy()
    light = view * given.light.numpy()[:, None] + (given.beams @ surface.normals.T).clamp(min=0).numpy()
    sky = view * given.sky.numpy()[:, None] + (1 - view) * given.around.numpy()[:, None]
    forcing, air = sun * light + share * sky, given.air.numpy()
    count, leak = len(rate), np.zeros(len(rate))
    if surface.inner is not None:
        forcing = forcing + surface.inner.numpy()
        leak = np.maximum(surface.inner.numpy() / given.room, 0.0) if given.room else leak
    mu, kappa = np.zeros(count), np.zeros(count)
    if surface.core is not None:
        mu, kappa = surface.core.log_rate.exp().numpy(), surface.core.coupling.numpy()
    anomaly = np.zeros_like(air) if given.wind_anomaly is None else given.wind_anomaly.numpy()
    none = np.zeros_like(air)
    vapour, rain, dries = (none if s is None else s.numpy() for s in (given.vapour, given.rain, given.dries))
    transpires = np.zeros(count) if surface.transpires is None else surface.transpires.numpy()
    calm = np.trapezoid(anomaly, times) / (times[-1] - times[0])
    mean = None if about is None else about.numpy()

    def radiated(x):
        return ((reference + x) ** 4 - reference**4) / (4 * reference**3)

    ends = np.unique(np.concatenate((times, moments.numpy())))
    ends = ends[ends <= moments.max().item()]
    behind = surface.start if surface.core is None else surface.core.start
    state = np.concatenate((surface.start.numpy(), behind.numpy(), np.zeros(count)))
    found = {ends[0]: state[:count]}
    steep = None if mean is None else (1 + mean / reference) ** 3
    still = None if mean is None else share * (radiated(mean) - steep * mean)
    jacobian = np.zeros((3 * count, 3 * count))
    own, across = np.arange(count), np.arange(count, 2 * count)
    jacobian[own, across], jacobian[across, own], jacobian[across, across] = rate * kappa, mu, -mu
    for begin, end in zip(ends[:-1], ends[1:], strict=True):
        k = min(np.searchsorted(times, begin, side="right") - 1, len(times) - 2)
        span = times[k + 1] - times[k]

        def now(series, t, k=k, span=span):
            return series[k] + (t - times[k]) / span * (series[k + 1] - series[k])

        def slope(t, state, now=now):
            x, y, film = state.reshape(3, count)
            drying = none[:count]
            a, b, f = now(air, t), now(anomaly, t), now(forcing, t) + kappa * (y - x) - leak * x
            if mean is None:
                evaporated = np.zeros(count)
                if given.vapour is not None:
                    wet = np.clip(film / COVERS_MM, 0.0, 1.0)
                    lacks = vapour_k(torch.from_numpy(x + reference), torch.tensor(100.0)).numpy() - now(vapour, t)
                    evaporated = (wet + (1 - wet) * np.where(lacks > 0, transpires, 0.0)) * lacks
                    drying = now(rain, t) - now(dries, t) * np.maximum(lacks, 0.0) * wet
                    drying = np.where((film >= given.holds_mm) & (drying > 0), 0.0, drying)
                taken = f + (1 - share) * (1 + wind * b) * (a - x - evaporated) - share * radiated(x)
            else:
                convected = (1 + wind * calm) * (a - x) + wind * (now(anomaly * air, t) - calm * a - (b - calm) * mean)
                taken = f + (1 - share) * convected - share * steep * x - still
            return np.concatenate((rate * taken, mu * (x - y), drying))

        def slopes(t, state, now=now):
            gusts, about_x = (now(anomaly, t), state[:count]) if mean is None else (calm, mean)
            exchange = (1 - share) * (1 + wind * gusts) + share * (1 + about_x / reference) ** 3
            jacobian[own, own] = -rate * (exchange + kappa + leak)
            return jacobian

        options = {"tfirst": True, "rtol": 1e-8, "atol": atol, "mxstep": 100_000}
        options |= {"Dfun": slopes} if given.vapour is None else {"hmax": 60.0, "rtol": 1e-7}
        state = odeint(slope, state, (begin, end), **options)[-1]
        found[end] = state[:count]
    return torch.tensor(np.stack([found[t] for t in moments.numpy()], axis=1))
