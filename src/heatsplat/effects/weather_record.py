"""How surfaces of several rates answer a weather record."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from heatsplat.contracts import SceneData, Weather
from heatsplat.effects.observations import Observations

# What recorded weather takes the place of, and why: a heat source stands for drivers that nobody recorded.
INSTEAD = {"harmonic_source": "the recorded weather drives the scene"}
QUICK_PER_S, SLOW_PER_S = 1 / 1200.0, 1 / 14400.0  # bodies that follow within 20 minutes and within 4 hours
MEAN_K = 290.0
# Root mean square over the frames of an answer to air and to light below which it warms nothing that an image shows.
LEAST_K, LEAST_W_M2 = 1e-3, 0.1
FORGOTTEN = 20.0  # time constants after which nothing is left of what a body was: 2e-9


def directed(scene: SceneData) -> str | None:
    """What a record lacks that says from where light comes; None where it lacks nothing."""
    if scene.weather is None:
        return "the scene lacks weather, which it needs"
    lacks = [name for name in ("sun", "direct_w_m2", "diffuse_w_m2") if getattr(scene.weather, name) is None]
    return f"the weather lacks {', '.join(lacks)}, which it needs" if lacks else None


def drives(weather: Weather | None) -> bool:
    """Whether a record says what surfaces follow over time: air or sun. Wind and rain alone warm and cool nothing."""
    return weather is not None and (weather.air_c is not None or weather.irradiance_w_m2 is not None)


def drivers(weather: Weather | None, times_s: Tensor | None, air: tuple[float, ...] = (SLOW_PER_S,)) -> Tensor | None:
    """Answers [F, k] to air (of bodies of these rates) and sun at the frames' times, of unit size; None without a record that
    ``drives``. What does not change while images are taken is none, such as sunlight by night: it would give each point numbers
    that explain nothing."""
    if times_s is None or not drives(weather):
        return None
    found = []
    if weather.air_c is not None:
        found.append(_answers(weather, weather.air_c, air, times_s) / LEAST_K)
    if weather.irradiance_w_m2 is not None:
        found.append(_answers(weather, weather.irradiance_w_m2, (QUICK_PER_S, SLOW_PER_S), times_s) / LEAST_W_M2)
    if weather.direct_w_m2 is not None and weather.sun is not None:
        # Walls that face the morning and walls that face the evening: the sun's way along the ground.
        level = weather.sun - (weather.sun @ weather.up)[:, None] * weather.up
        _, _, axes = torch.linalg.svd(level - level.mean(0), full_matrices=False)
        found.append(_answers(weather, weather.direct_w_m2 * (level @ axes[0]), (SLOW_PER_S,), times_s) / LEAST_W_M2)
    found = torch.cat(found, 1)
    size = found.norm(dim=0)
    shows = size > math.sqrt(len(found))
    shows[size.argmax()] = True  # one at least: a record stands for relaxation
    return found[:, shows] / size[shows].clamp_min(1e-12)


def bent(obs: Observations) -> bool:
    """Whether T⁴ departs from a straight line over the span of temperatures by more than the noise of the images shows.

    For a surface at T about a mean M, the excess over the line is (T - M)² · 3 / (2 M) to second order, in kelvin. Only tracks
    tell it.
    """
    span_k = _span(torch.where(obs.tracks.weights > 0, obs.tracks.values, torch.nan)) * obs.unit_k
    return 1.5 * (0.5 * span_k) ** 2 / MEAN_K > 3.0 * obs.noise * obs.unit_k


def _span(values: Tensor) -> float:
    """Range over time [P, F] (nan where not seen) that a tenth of the points exceed."""
    low = torch.nan_to_num(values, nan=torch.inf).amin(1)
    high = torch.nan_to_num(values, nan=-torch.inf).amax(1)
    return float((high - low)[(high > low)].quantile(0.9)) if bool((high > low).any()) else 0.0


def samples_around(samples_s: Tensor, times_s: Tensor) -> tuple[Tensor, Tensor]:
    """For times [F] the sample [F] after each, never the first, and the share [F] of the way to it from the one before."""
    after = torch.searchsorted(samples_s, times_s).clamp(1, len(samples_s) - 1)
    share = (times_s - samples_s[after - 1]) / (samples_s[after] - samples_s[after - 1])
    return after, share.clamp(0, 1)


def at(weather: Weather, series: Tensor, times_s: Tensor) -> Tensor:
    """A series [T, ...] of the record at times [F] within it, linear between samples; its ends beyond."""
    return _between(weather.times_s, series, times_s)


def _between(samples_s: Tensor, series: Tensor, times_s: Tensor) -> Tensor:
    after, share = samples_around(samples_s, times_s)
    share = share.reshape(-1, *[1] * (series.ndim - 1))
    return series[after - 1] * (1 - share) + series[after] * share


def remembered(times_s: Tensor, per_s: Tensor, frames_s: Tensor) -> slice:
    """Of the samples [T] of a record, those that bodies at the frames' times [F] still know of: all but what came after the last
    frame, and what they have forgotten by the first. A record of a year else takes a year's time.

    Args:
        per_s: [T - 1] or a number: the least rate of the bodies from each sample to the next.
    """
    last = int(torch.searchsorted(times_s, frames_s.max()).clamp(1, len(times_s) - 1))
    first = int(torch.searchsorted(times_s, frames_s.min()).clamp(1, len(times_s) - 1))
    passed = (per_s * times_s.diff())[: first - 1].flip(0).cumsum(0)
    return slice(first - 1 - int((passed < FORGOTTEN).sum()), last + 1)


def _answers(weather: Weather, series: Tensor, rates: tuple[float, ...], times_s: Tensor) -> Tensor:
    """What bodies of these rates make of a series, [F, rates], in its unit and centred."""
    seen = remembered(weather.times_s, torch.tensor(min(rates)), times_s)
    series, steps = (series - series.mean())[seen], weather.times_s[seen].diff()
    columns = []
    for rate in rates:
        keep, state = torch.exp(-rate * steps), torch.zeros_like(series)
        for i in range(len(steps)):
            state[i + 1] = keep[i] * state[i] + (1 - keep[i]) * 0.5 * (series[i] + series[i + 1])
        columns.append(_between(weather.times_s[seen], state, times_s))
    found = torch.stack(columns, 1)
    return found - found.mean(0)
