"""What sun, sky and wind each explain of a scene under recorded weather: balances of heat fitted with and without them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from heatsplat.contracts import Weather
from heatsplat.effects import weather_record
from heatsplat.effects.base import Evidence
from heatsplat.effects.joint.held_out import FOLDS, WORST, HeldOut, compared, fold_of
from heatsplat.physics.responses import semi_infinite_weights
from heatsplat.physics.sky import sky_temperature_k
from heatsplat.physics.units import STEFAN_BOLTZMANN, kelvin

# Standard errors from which a gain on held-out observations is no chance, and below which it is; decibels that are none.
SIGMAS, CHANCE = 3.0, 0.5
MIN_DB, NOTHING_DB = 0.2, 0.05
NO_BALANCE = "there is no record of the air's temperature, or no point to follow through the images"
PARTS = ("solar", "radiation", "convection")
DEPTH = "depth"  # bodies with a core beside their surface
ENDLESS = "semi_infinite"  # bodies without an end, in the place of those of one rate
RATES_PER_S = [1.0 / (60.0 * minutes) for minutes in (5, 10, 20, 40, 80, 160, 320, 640, 1280)]
DEEPER = 1.0 / 8.0  # rate of a body's core beside that of its surface
OCTAVES = 10  # on each side of a body without an end, of rates of which it is a mean; what lies beyond, 2 %, counts at the ends
# What wind adds to the exchange at its mean, as a share of that without wind: none, and McAdams' order of magnitude.
WINDS = (0.0, 0.5, 1.5)
EXCHANGE_W_M2_K = 10.0  # typical; light and long waves are counted in what they add to a temperature at this exchange
# What a body's own numbers are expected to be: its start in kelvin, and shares. Without expectations few frames would give
# numbers that are none.
EXPECTED = {"start": 10.0, "deep air": 0.5, "beam": 0.7, "diffuse": 0.7, "deep light": 0.5, "sky": 0.7}
SHARE_OF = {"beam": 0, "diffuse": 0, "deep light": 0, "sky": 1}  # column of the shares that a number adds to
# Least shares that are an effect: absorptivity or emissivity over exchange in units of 10 W/m²K. A dull surface in a strong wind
# has 0.1 and more, bare metal 0.04 of long waves.
LEAST = {"solar": 0.05, "radiation": 0.1}
DARK_W_M2, DARK_FRAMES = 5.0, 0.2  # irradiance, and share of the frames
MODEL_K = 0.3  # by which a body of two rates errs itself


def judged(weathered: Weathered | None, name: str, why: str) -> Evidence:
    """Whether a balance of heat with one of PARTS explains observations better that it was not fitted to.

    Args:
        why: there is nothing to fit.
    """
    if weathered is None:
        return Evidence(None, why, told=False)
    gain = weathered.gain(name)
    found = f"balances of heat gain {gain.db:.2f} dB by it where left out, {gain.sigmas:.1f} standard errors"
    sure, large = gain.sigmas > SIGMAS and gain.db > MIN_DB, True
    if name in LEAST:
        share = weathered.shares[name]
        found, large = f"{found}; bodies take a share of {share:.2f}", share > LEAST[name]
    if sure and large:
        return Evidence(gain.sigmas, found, gain_db=gain.db)
    nothing = gain.sigmas < CHANCE or gain.db < NOTHING_DB
    if nothing and (name != "radiation" or weathered.dark):
        return Evidence(min(gain.sigmas, CHANCE), found, gain_db=gain.db)
    needed = math.ceil(gain.images * (SIGMAS / max(gain.sigmas, CHANCE)) ** 2)
    what = "more of them in the dark" if name == "radiation" and not weathered.dark else f"about {needed}"
    why = f"cannot be told from {gain.images} frames, {what} would tell"
    return Evidence(gain.sigmas, f"{found}: {why}", told=False, gain_db=gain.db)


@dataclass(frozen=True, eq=False)
class Weathered:
    """P points in F frames under a weather record.

    Args:
        weather: the record.
        times_s: [F] of the frames.
        values: [P, F] temperatures in °C, without what the camera adds.
        errors, weights: [P, F] that are to be expected in kelvin, and 0 where a point is not seen.
        normals: [P, 3] of the surface, or None.
    """

    weather: Weather
    times_s: Tensor
    values: Tensor
    errors: Tensor
    weights: Tensor
    normals: Tensor | None

    @property
    def nodes(self) -> int:
        """Temperatures that a body has: 2, surface and core, where that explains observations better that were left out."""
        gain = self.gain(DEPTH)
        return 2 if gain.sigmas > SIGMAS and gain.db > MIN_DB else 1

    def gain(self, name: str) -> HeldOut:
        """What one of the parts gains beside the others."""
        return compared(self._whole, self.squares(self._others(name)), self.weights)

    @cached_property
    def endless(self) -> tuple[HeldOut, HeldOut]:
        """What bodies without an end gain over those of one rate, and what those with a core gain over them."""
        one = self._others(DEPTH)
        without_end = self.squares((*one, ENDLESS))
        return (
            compared(without_end, self.squares(one), self.weights),
            compared(self._whole, without_end, self.weights),
        )

    def _others(self, name: str) -> tuple[str, ...]:
        return tuple(part for part in self.parts if part != name)

    @cached_property
    def _whole(self) -> Tensor:
        return self.squares(self.parts)

    @cached_property
    def parts(self) -> tuple[str, ...]:
        """Of PARTS, those that the record knows, and DEPTH."""
        weather = self.weather
        known = {
            "solar": weather.irradiance_w_m2 is not None and float(weather.irradiance_w_m2.max()) > 0,
            "radiation": True,
            "convection": weather.wind_m_s is not None,
        }
        return (*(name for name in PARTS if known[name]), DEPTH)

    def squares(self, parts: tuple[str, ...]) -> Tensor:
        """Squared errors [P, F], in squares of the expected ones, at observations that the balance with these parts was not
        fitted to."""
        fold = fold_of(*self.values.shape)
        found = torch.zeros_like(self.values)
        for k in range(FOLDS):
            found = torch.where(fold == k, self._best(parts, self.weights * (fold != k))[0], found)
        return found

    @cached_property
    def shares(self) -> dict[str, float]:
        """What bodies take of light and of long waves, where they exchange 10 W/m²K with the air; medians over the points."""
        seen = self.weights.sum(1) > 0
        light, waves = self._best(self.parts, self.weights)[1][seen].median(0).values.tolist()
        return {"solar": light, "radiation": waves}

    @cached_property
    def dark(self) -> bool:
        """Whether enough frames were taken without the sun, under which alone the sky is told from it."""
        if self.weather.irradiance_w_m2 is None:
            return False
        light = weather_record.at(self.weather, self.weather.irradiance_w_m2, self.times_s)
        return float((light < DARK_W_M2).double().mean()) >= DARK_FRAMES

    def _best(self, parts: tuple[str, ...], weights: Tensor) -> tuple[Tensor, Tensor]:
        """Squared errors [P, F] and shares [P, 2] of the likeliest balance; each point has its own rate, all the same wind."""
        found, least = None, math.inf
        for winds in WINDS if "convection" in parts else WINDS[:1]:
            squares, shares = torch.zeros_like(self.values), torch.zeros_like(self.values[:, :2])
            costs = torch.full_like(self.values[:, 0], torch.inf)
            for number in range(len(RATES_PER_S)):
                left, taken, cost = self._fitted(winds, number, parts, weights)
                better = (cost < costs)[:, None]
                squares, shares = torch.where(better, left, squares), torch.where(better, taken, shares)
                costs = torch.minimum(cost, costs)
            if found is None or float(costs.sum()) < least:
                found, least = (squares, shares), float(costs.sum())
        return found

    def _fitted(
        self, winds: float, number: int, parts: tuple[str, ...], weights: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Squared errors [P, F] of the likeliest numbers, shares of light and of long waves [P, 2] that these are, and how
        unlikely they and the observations that count are [P].

        No sky warms and no sun cools: what would need that is fitted without.
        """
        base, basis, names = self._responses(winds, number, parts)
        variance = self.errors**2 + MODEL_K**2
        values, used = self.values - base, (weights > 0) / variance
        inner = torch.einsum("pf,pfi,pfj->pij", used, basis, basis) + torch.eye(basis.shape[2], dtype=basis.dtype)
        numbers = torch.linalg.solve(inner, torch.einsum("pf,pfi,pf->pi", used, basis, values))
        squares = ((values - (basis @ numbers[..., None])[..., 0]) ** 2 / variance).clamp(max=WORST)
        cost = (squares * (weights > 0)).sum(1) + (numbers**2).sum(1)
        shares = torch.zeros_like(values[:, :2])
        for column, name in enumerate(names):
            if name in SHARE_OF:
                shares[:, SHARE_OF[name]] += EXPECTED[name] * numbers[:, column]
        for place, part in enumerate(("solar", "radiation")):
            if part in parts and bool((shares[:, place] < 0).any()):
                less = self._fitted(winds, number, tuple(one for one in parts if one != part), weights)
                possible = shares[:, place] >= 0
                squares, cost = torch.where(possible[:, None], squares, less[0]), torch.where(possible, cost, less[2])
                shares = torch.where(possible[:, None], shares, less[1])
        return squares, shares, cost

    def _responses(self, winds: float, number: int, parts: tuple[str, ...]) -> tuple[Tensor, Tensor, list[str]]:
        """What the air makes of a body of a rate [F], what its own numbers multiply [P, F, k], and their names."""
        courses = (self._endless if ENDLESS in parts else self._courses)[winds, number]
        names = ["start"]
        names += ["beam", "diffuse"] if "solar" in parts else []
        names += ["deep air"] if DEPTH in parts else []
        names += ["deep light"] if DEPTH in parts and "solar" in parts else []
        names += ["sky"] if "radiation" in parts else []
        basis = [(EXPECTED[name] * courses[name]).expand(len(self.values), -1) for name in names]
        return courses["air"], torch.stack(basis, 2), names

    @cached_property
    def _courses(self) -> dict[tuple[float, int], dict[str, Tensor]]:
        """Answers to air, light and sky at the frames' times by wind and rate, each [F] or [P, F]."""
        courses = {}
        for winds in WINDS:
            near, start = self._answers(winds, RATES_PER_S)
            deep, _ = self._answers(winds, [DEEPER * rate for rate in RATES_PER_S])
            for number in range(len(RATES_PER_S)):
                cores = {"deep air": deep[number, :, 0] - near[number, :, 0], "deep light": deep[number, :, 3]}
                courses[winds, number] = _named(near[number], start[number]) | cores
        return courses

    @cached_property
    def _endless(self) -> dict[tuple[float, int], dict[str, Tensor]]:
        """The same of bodies without an end by wind and a, the number in the place of their rate: means over bodies of one
        rate (``physics.responses.SemiInfiniteTable``), exact where the wind is steady."""
        octave = math.log(2.0)  # from one of RATES_PER_S to the next
        rates = [RATES_PER_S[-1] * 2.0**place for place in range(-OCTAVES, len(RATES_PER_S) + OCTAVES)]
        courses = {}
        for winds in WINDS:
            near, start = self._answers(winds, rates)
            for number, rate in enumerate(RATES_PER_S):
                distances = torch.tensor([math.log(other / rate) for other in rates], dtype=torch.float64)
                counts = semi_infinite_weights(distances, octave)
                courses[winds, number] = _named(torch.tensordot(counts, near, 1), counts @ start)
        return courses

    @cached_property
    def _drivers(self) -> tuple[Tensor, Tensor]:
        """Air in °C, then sky, diffuse, level light and beams in kelvin [T, d]; and wind over its mean [T]."""
        weather = self.weather
        zero = torch.zeros_like(weather.times_s)
        wind = zero + 1.0 if weather.wind_m_s is None else weather.wind_m_s / weather.wind_m_s.mean().clamp_min(0.1)
        light = zero if weather.irradiance_w_m2 is None else weather.irradiance_w_m2
        air_k = kelvin(weather.air_c)
        law = "swinbank" if weather.humidity_percent is None else "brutsaert"
        sky_k = sky_temperature_k(air_k, weather.humidity_percent, law)
        net = STEFAN_BOLTZMANN * (sky_k**4 - air_k**4)
        beam, diffuse = light[:, None], zero
        if self.normals is not None and weather.direct_w_m2 is not None and weather.sun is not None:
            beam = weather.direct_w_m2[:, None] * (weather.sun @ self.normals.T).clamp_min(0.0)
            diffuse = zero if weather.diffuse_w_m2 is None else weather.diffuse_w_m2
        power = torch.cat([net[:, None], diffuse[:, None], light[:, None], beam], 1) / EXCHANGE_W_M2_K
        return torch.cat([weather.air_c[:, None], power], 1), wind

    def _answers(self, winds: float, rates_per_s: Sequence[float]) -> tuple[Tensor, Tensor]:
        """u' = rate · gain · driver - rate · exchange · u at the frames' times [R, F, d], from rest; and the decay [R, F] from 1.

        Args:
            rates_per_s: R rates at the mean exchange.
        """
        drivers, wind = self._drivers
        times, rate = self.weather.times_s, torch.tensor(rates_per_s, dtype=torch.float64)[:, None]
        exchange = (1.0 + winds * wind) / (1.0 + winds)
        # Of long waves and light the body takes what it takes; wind changes how soon it gives that to the air.
        driven = torch.cat([exchange[:, None] * drivers[:, :1], drivers[:, 1:]], 1)
        driven = torch.cat(
            [0.5 * (driven[1:] + driven[:-1]), torch.zeros_like(driven[1:, :1])], 1
        )  # nothing drives the decay
        given = rate * 0.5 * (exchange[1:] + exchange[:-1])
        keep = torch.exp(-given * times.diff())
        over = rate * (1.0 - keep) / given
        rest = torch.cat([drivers[0, :1], drivers[0, 1:] / exchange[0], torch.ones(1, dtype=torch.float64)])
        state = rest.expand(len(rate), -1)
        above = torch.searchsorted(times, self.times_s).clamp(1, len(times) - 1)
        share = ((self.times_s - times[above - 1]) / (times[above] - times[above - 1])).clamp(0, 1)[:, None]
        found = state.new_zeros(len(rate), len(self.times_s), len(rest))
        for i in range(len(times) - 1):
            after = keep[:, i, None] * state + over[:, i, None] * driven[i]
            here = (above == i + 1).nonzero()[:, 0]
            if len(here):
                found[:, here] = torch.lerp(state[:, None], after[:, None], share[here])
            state = after
        return found[..., :-1], found[..., -1]


def _named(answers: Tensor, start: Tensor) -> dict[str, Tensor]:
    """Answers [F, d] to ``Weathered._drivers`` and the decay of the start [F] by name."""
    air, sky, diffuse, _ = answers[:, :4].unbind(1)
    return {"air": air, "sky": sky, "diffuse": diffuse, "beam": answers[:, 4:].T, "start": start}
