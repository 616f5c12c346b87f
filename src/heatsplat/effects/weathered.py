"""What sun, sky and wind each explain of a scene under recorded weather: balances of heat fitted with and without them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from heatsplat.contracts import Weather
from heatsplat.effects import weather_record
from heatsplat.effects.base import Evidence
from heatsplat.effects.full_balance import FullBalance
from heatsplat.effects.joint.held_out import CHANCE, FOLDS, WORST, HeldOut, compared, fold_of, would_tell
from heatsplat.effects.observations import Tracks
from heatsplat.geometry.exposure import felt_directions, lit_beside, sky_directions
from heatsplat.geometry.rotations import reflected
from heatsplat.physics.responses import semi_infinite_weights
from heatsplat.physics.sky import emissivity_towards, law_for, optical_depth, sky_temperature_k
from heatsplat.physics.units import STEFAN_BOLTZMANN, kelvin
from heatsplat.physics.wetness import FILM_MM

if TYPE_CHECKING:
    from heatsplat.effects.inspection import Inspection

# Standard errors from which a gain on held-out observations is no chance (below CHANCE it is); decibels that are none.
SIGMAS = 3.0
# Those of sun, sky and wind, which are there more often than not under the sky. A part that is absent loses on such observations:
# of 32 that were in 38 scenes drawn at random one gained 2.8 standard errors, one 1.9, and the others 1.0 at most.
PART_SIGMAS = 2.0
MIN_DB, NOTHING_DB, MUCH_DB = 0.2, 0.05, 0.5
FULL_POINTS = 250  # that full balances are fitted to, at most: images scatter more than points do
FULL_DB = 0.05  # that are a gain where full balances tell it
# Standard errors by which images speak against rain and clouds of a record, which wet surfaces and warm the sky more often than
# not; and what plants gain, which make up for little where there are none (0.9 standard errors on 24 scenes drawn at random).
AGAINST = -1.5
PLANTS_DB, PLANTS_SIGMAS = 0.05, 1.0
NO_BALANCE = "there is no record of the air's temperature, or no point to follow through the images"
NO_SUN = "the record has no irradiance, or the sun does not shine in it"
NO_LIGHT = "nobody knows from where light comes, or how surfaces face it"
PARTS = ("solar", "radiation", "convection")
DEPTH = "depth"  # bodies with a core beside their surface
ENDLESS = "semi_infinite"  # bodies without an end, in the place of those of one rate
# What the scene's own geometry does, which is asked for beside all of these: shadows, light that comes back from the ground, sky
# that is mirrored; and hidden sky, which shows where beams and diffuse light are taken in one measure (ONE_LIGHT).
SHADOWS, ALBEDO, MIRRORED, SKY_VIEW, ONE_LIGHT = "shadows", "albedo", "mirrored_sky", "sky_view", "one light"
BEAMS = 4  # drivers before those of the sun's beams, one for each way that points face (``Weathered._drivers``)
SKY_PARTS = 64  # of the sky that are asked whether they are open
NEIGHBOURS = 6  # of a point, of whose temperature it takes a share where heat flows between them
FLOW = 0.5  # that share, as expected
RATES_PER_S = [1.0 / (60.0 * minutes) for minutes in (5, 10, 20, 40, 80, 160, 320, 640, 1280)]
DEEPER = 1.0 / 8.0  # rate of a body's core beside that of its surface
OCTAVES = 10  # on each side of a body without an end, of rates of which it is a mean; what lies beyond, 2 %, counts at the ends
# What wind adds to the exchange at its mean, as a share of that without wind: none, and McAdams' order of magnitude.
WINDS = (0.0, 0.5, 1.5)
EXCHANGE_W_M2_K = 10.0  # typical; light and long waves are counted in what they add to a temperature at this exchange
# What a body's own numbers are expected to be: its start in kelvin, and shares. Without expectations few frames would give
# numbers that are none.
EXPECTED = {
    "start": 10.0, "deep air": 0.5, "beam": 0.7, "diffuse": 0.7, "deep light": 0.5, "sky": 0.7, "ground": 0.2, "mirror": 0.1,
}  # fmt: skip
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
    # Where frames are few, linear balances are told by what is expected of them; of many, full ones explain three times as much.
    linear, full = weathered.gain(name), weathered.full_gain(name)
    fully = (full.exceeds(FULL_DB, PART_SIGMAS), full.sigmas) > (linear.exceeds(MIN_DB, PART_SIGMAS), linear.sigmas)
    gain, least_db = (full, FULL_DB) if fully else (linear, MIN_DB)
    found = f"balances of heat gain {gain.db:.2f} dB by it where left out, {gain.sigmas:.1f} standard errors"
    large, none = True, True
    if name in LEAST:
        share = weathered.shares[name]  # of linear balances, which say less where full ones gain
        large, none = fully or share > LEAST[name], share <= LEAST[name]
        # Few frames gain nothing by it, but what bodies take says that it may be there. Where it is not, that is 0.02 at most.
        found = f"{found}; bodies take a share of {share:.2f}"
    nothing_db = 0.25 * least_db if gain.sigmas <= PART_SIGMAS else 0.0  # what is no chance is there, however small
    if name == "radiation" and not weathered.dark:
        evidence = weighed(gain, found, large, False, "more of them in the dark", least_db, sigmas=PART_SIGMAS)
    else:
        evidence = weighed(gain, found, large, none, "", least_db, nothing_db, PART_SIGMAS)
    # Sun, sky and wind are there more often than not under the sky.
    return replace(evidence, likely=gain.sigmas > CHANCE)


def around(inspected: Inspection, name: str) -> Evidence:
    """Whether what one of SHADOWS, ALBEDO, MIRRORED and SKY_VIEW does explains observations better that balances of heat without
    it were fitted to."""
    weathered = inspected.weathered
    if weathered is None:
        return Evidence(None, inspected.obs.why or NO_BALANCE, told=False)
    if name != MIRRORED and "solar" not in weathered.parts:
        return Evidence(None, NO_SUN)
    gain = weathered.beside(name)
    if gain is None:
        return Evidence(None, NO_LIGHT, told=False)
    found = f"balances of heat gain {gain.db:.2f} dB by it where left out, {gain.sigmas:.1f} standard errors"
    if name == SHADOWS:  # which add no number to a balance: where there are none, they make it worse
        return weighed(gain, found, least_db=NOTHING_DB)
    # What balances miss is taken for these, which have numbers of their own: up to 0.5 dB where none of them is there.
    evidence = weighed(gain, found, least_db=MUCH_DB, nothing_db=MIN_DB)
    return replace(evidence, settings={"clouds": weathered.clouded}) if name == MIRRORED else evidence


def water_on(inspected: Inspection) -> dict[str, Any]:
    """What the state of a scene is told of water: mm of rain that surfaces keep, None for none, and whether they transpire."""
    weathered = _as_it_stands(inspected)
    if weathered is None:
        return {"rain": None, "transpires": False}
    return {"rain": FILM_MM if weathered.rained else None, "transpires": weathered.transpires}


def told_of_water(inspected: Inspection) -> str:
    """Clauses of a reason on what rain and plants gain, each after a semicolon; empty where nothing is told of them."""
    weathered = _as_it_stands(inspected)
    if weathered is None:
        return ""
    rain = _told(weathered.rain, "rain wets surfaces" if weathered.rained else "rain leaves surfaces dry")
    return rain + _told(weathered.plants, "surfaces transpire" if weathered.transpires else "surfaces do not transpire")


def told_of_clouds(weathered: Weathered | None) -> str:
    """The same on clouds of the record."""
    if weathered is None:
        return ""
    return _told(weathered.clouds, "clouds warm the sky" if weathered.clouded else "clouds leave the sky cold")


def _as_it_stands(inspected: Inspection) -> Weathered | None:
    """What only a balance knows that is solved as it stands; None where it will be solved about its mean, or nothing is told."""
    told = inspected.weathered is not None and inspected.obs.tracks is not None
    return inspected.weathered if told and weather_record.bent(inspected.obs) else None


def _told(gain: HeldOut | None, found: str) -> str:
    return "" if gain is None else f"; {found} (gain {gain.db:.2f} dB, {gain.sigmas:.1f} standard errors)"


def weighed(
    gain: HeldOut,
    found: str,
    large: bool = True,
    can_be_none: bool = True,
    needed: str = "",
    least_db: float = MIN_DB,
    nothing_db: float = NOTHING_DB,
    sigmas: float = SIGMAS,
) -> Evidence:
    """The evidence of what a balance gains on observations that were left out.

    Args:
        found: says that.
        large: whether the effect is large enough to be one.
        can_be_none: whether no gain says that there is none.
        needed: frames that would tell; else their number, from how the gain scatters (``would_tell``).
        least_db, nothing_db: decibels that are a gain, and that are none.
        sigmas: standard errors from which a gain is no chance.
    """
    if gain.exceeds(least_db, sigmas) and large:
        return Evidence(gain.sigmas, found, gain_db=gain.db)
    if (gain.sigmas < CHANCE or gain.db < nothing_db) and can_be_none:
        return Evidence(min(gain.sigmas, CHANCE), found, gain_db=gain.db)
    if gain.sigmas > sigmas and not needed:  # more frames make it more certain, but no larger
        why = "cannot be told from what balances leave unexplained, for it is too small"
    else:
        more_frames = f"{needed} would tell" if needed else would_tell(gain, sigmas)
        why = f"cannot be told from {gain.images} frames, {more_frames}"
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
        tracks: where the points are, and from where they are seen; None: what asks for that is not told.
        around: [Q, 3] points of the scene, which stand in the way of light.
    """

    weather: Weather
    times_s: Tensor
    values: Tensor
    errors: Tensor
    weights: Tensor
    normals: Tensor | None
    tracks: Tracks | None = None
    around: Tensor | None = None

    @property
    def nodes(self) -> int:
        """Temperatures that a body has: 2, surface and core, where that explains observations better that were left out."""
        return 2 if self.gain(DEPTH).exceeds(MIN_DB, SIGMAS) else 1

    @property
    def rained(self) -> bool:
        """Whether the record's rain wets surfaces: it does, unless dry ones explain observations better that were left out."""
        return self.rain is not None and self.rain.sigmas > AGAINST

    @property
    def clouded(self) -> bool:
        """Whether clouds of the record warm the sky: they do, unless a clear one explains observations better that were left
        out. Many a fair day does not tell, and overcast ones are foreseen wrongly without clouds."""
        return self.clouds is not None and self.clouds.sigmas > AGAINST

    @property
    def transpires(self) -> bool:
        """Whether surfaces that evaporate water where they are dry, each its own share, explain them better."""
        return self.plants is not None and self.plants.exceeds(PLANTS_DB, PLANTS_SIGMAS)

    @cached_property
    def rain(self) -> HeldOut | None:
        """What the record's rain gains; None where it tells of none, or not how moist the air is."""
        return self._over(replace(self.full, film_mm=FILM_MM), self.full) if self._rains else None

    @property
    def _rains(self) -> bool:
        rain, humid = self.weather.rain_mm_h, self.weather.humidity_percent is not None
        return humid and rain is not None and bool((rain > 0).any())

    @cached_property
    def clouds(self) -> HeldOut | None:
        """What clouds of the record gain; None where it does not tell them, or no sky is asked for."""
        if self.weather.clouds is None or "radiation" not in self.parts:
            return None
        return self._over(replace(self._wet, sky_k=self._clouded_k), self._wet)

    @cached_property
    def plants(self) -> HeldOut | None:
        """What transpiration gains; None where nobody knows how moist the air is."""
        if self.weather.humidity_percent is None:
            return None
        dry = replace(self._wet, sky_k=self._clouded_k) if self.clouded else self._wet
        return self._over(replace(dry, transpires=True), dry)

    @cached_property
    def full(self) -> FullBalance:
        """Full balances of some of the points, dry and under a clear sky."""
        some = slice(None, None, max(1, math.ceil(len(self.values) / FULL_POINTS)))
        seen = [None if one is None else one[some] for one in (self.values, self.errors, self.weights, self.normals)]
        return FullBalance(self.weather, self._sky_k, self.times_s, *seen)

    @cached_property
    def likeliest(self) -> FullBalance:
        """Full balances of all points: under clouds, rain and with plants where those of ``full`` are likelier so."""
        some = self.full
        for one in self._may_be:
            with_it = replace(some, **one)
            some = with_it if with_it.unlikely < some.unlikely else some
        return replace(some, values=self.values, errors=self.errors, weights=self.weights, normals=self.normals)

    @property
    def _may_be(self) -> list[dict[str, Any]]:
        """What may hold of full balances beside what ``full`` takes."""
        humid = self.weather.humidity_percent is not None
        clouds = [] if self.weather.clouds is None else [{"sky_k": self._clouded_k}]
        return clouds + ([{"film_mm": FILM_MM}] if self._rains else []) + ([{"transpires": True}] if humid else [])

    @cached_property
    def _wet(self) -> FullBalance:
        """The same under rain, where it wets."""
        return replace(self.full, film_mm=FILM_MM) if self.rained else self.full

    def gain(self, name: str) -> HeldOut:
        """What one of the parts gains beside the others in linear balances."""
        return compared(self._whole, self.squares(self._others(name)), self.weights)

    def full_gain(self, name: str) -> HeldOut:
        """What one of PARTS gains beside the others in full balances."""
        return self._over(self.full, self.full.without(name))

    def _over(self, more: FullBalance, less: FullBalance) -> HeldOut:
        return compared(more.squares, less.squares, self.full.weights)

    def beside(self, name: str) -> HeldOut | None:
        """What one of SHADOWS, ALBEDO, MIRRORED and SKY_VIEW gains; None where nobody knows how surfaces face light or, but for
        MIRRORED, from where it comes."""
        weather = self.weather
        known = (self.normals, self.tracks)
        if name != MIRRORED:  # which needs no light: a record in seconds, without the sun's direction, tells it as well
            known += (self.around, weather.sun, weather.direct_w_m2, weather.diffuse_w_m2)
        if any(one is None for one in known):
            return None
        less = (*self.parts, ONE_LIGHT) if name == SKY_VIEW else self.parts
        return compared(self.squares((*less, name), True), self.squares(less, True), self.weights)

    @cached_property
    def follows(self) -> HeldOut:
        """What balances gain over points that keep their level."""
        fold, levels = fold_of(*self.values.shape), torch.zeros_like(self.values)
        for k in range(FOLDS):
            used = (self.weights > 0) * (fold != k) / self._variance
            mean = (used * self.values).sum(1, keepdim=True) / used.sum(1, keepdim=True).clamp_min(1e-12)
            levels = torch.where(fold == k, mean, levels)
        return compared(self._whole, ((self.values - levels) ** 2 / self._variance).clamp(max=WORST), self.weights)

    @cached_property
    def flow(self) -> HeldOut | None:
        """What points gain by a share of what they lack to the mean of their neighbours; None without neighbours."""
        if self.tracks is None or len(self.values) <= NEIGHBOURS:
            return None
        points, fold = self.tracks.points, fold_of(*self.values.shape)
        near = torch.cdist(points, points).topk(NEIGHBOURS + 1, largest=False).indices[:, 1:]
        apart, joined = torch.zeros_like(self.values), torch.zeros_like(self.values)
        for k in range(FOLDS):
            used = (self.weights > 0) * (fold != k)
            left = self._best(self.parts, used, (self.wind,))[0]
            lacking = (self.values - left)[near].mean(1) - (self.values - left)
            over = used / self._variance
            share = (over * lacking * left).sum(1) / ((over * lacking**2).sum(1) + 1.0 / FLOW**2)
            apart = torch.where(fold == k, left, apart)
            joined = torch.where(fold == k, left - share[:, None] * lacking, joined)
        squares = [(left**2 / self._variance).clamp(max=WORST) for left in (joined, apart)]
        return compared(*squares, self.weights)

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

    @property
    def _variance(self) -> Tensor:
        return self.errors**2 + MODEL_K**2

    def squares(self, parts: tuple[str, ...], same_wind: bool = False) -> Tensor:
        """Squared errors [P, F], in squares of the expected ones, at observations that the balance with these parts was not
        fitted to.

        Args:
            same_wind: wind counts as it does in the balance of all observations.
        """
        fold = fold_of(*self.values.shape)
        left = torch.zeros_like(self.values)
        for k in range(FOLDS):
            winds = (self.wind,) if same_wind else WINDS
            left = torch.where(fold == k, self._best(parts, self.weights * (fold != k), winds)[0], left)
        return (left**2 / self._variance).clamp(max=WORST)

    @cached_property
    def shares(self) -> dict[str, float]:
        """What bodies take of light and of long waves, where they exchange 10 W/m²K with the air; medians over the points."""
        seen = self.weights.sum(1) > 0
        light, waves = self._all[1][seen].median(0).values.tolist()
        return {"solar": light, "radiation": waves}

    @property
    def wind(self) -> float:
        """What wind adds to the exchange, of WINDS, as all observations say."""
        return self._all[2]

    @cached_property
    def _all(self) -> tuple[Tensor, Tensor, float]:
        return self._best(self.parts, self.weights)

    @cached_property
    def dark(self) -> bool:
        """Whether enough frames were taken without the sun, under which alone the sky is told from it."""
        if self.weather.irradiance_w_m2 is None:
            return False
        light = weather_record.at(self.weather, self.weather.irradiance_w_m2, self.times_s)
        return float((light < DARK_W_M2).double().mean()) >= DARK_FRAMES

    def _best(
        self, parts: tuple[str, ...], weights: Tensor, among: tuple[float, ...] = WINDS
    ) -> tuple[Tensor, Tensor, float]:
        """What the likeliest balance leaves in kelvin [P, F], shares [P, 2] and wind; each point has its own rate, all the same
        wind."""
        found, least = None, math.inf
        for winds in among if "convection" in parts else WINDS[:1]:
            left, shares = torch.zeros_like(self.values), torch.zeros_like(self.values[:, :2])
            costs = torch.full_like(self.values[:, 0], torch.inf)
            for number in range(len(RATES_PER_S)):
                leaves, taken, cost = self._fitted(winds, number, parts, weights)
                better = (cost < costs)[:, None]
                left, shares = torch.where(better, leaves, left), torch.where(better, taken, shares)
                costs = torch.minimum(cost, costs)
            if found is None or float(costs.sum()) < least:
                found, least = (left, shares, winds), float(costs.sum())
        return found

    def _fitted(
        self, winds: float, number: int, parts: tuple[str, ...], weights: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What the likeliest numbers leave [P, F], shares of light and of long waves [P, 2] that these are, and how unlikely
        they and the observations that count are [P].

        No sky warms and no sun cools: what would need that is fitted without.
        """
        base, basis, names = self._responses(winds, number, parts)
        values, used = self.values - base, (weights > 0) / self._variance
        inner = torch.einsum("pf,pfi,pfj->pij", used, basis, basis) + torch.eye(basis.shape[2], dtype=basis.dtype)
        numbers = torch.linalg.solve(inner, torch.einsum("pf,pfi,pf->pi", used, basis, values))
        left = values - (basis @ numbers[..., None])[..., 0]
        cost = ((left**2 / self._variance).clamp(max=WORST) * (weights > 0)).sum(1) + (numbers**2).sum(1)
        shares = torch.zeros_like(values[:, :2])
        for column, name in enumerate(names):
            if name in SHARE_OF:
                shares[:, SHARE_OF[name]] += EXPECTED[name] * numbers[:, column]
        for place, part in enumerate(("solar", "radiation")):
            if part in parts and bool((shares[:, place] < 0).any()):
                less = self._fitted(winds, number, tuple(one for one in parts if one != part), weights)
                possible = shares[:, place] >= 0
                left, cost = torch.where(possible[:, None], left, less[0]), torch.where(possible, cost, less[2])
                shares = torch.where(possible[:, None], shares, less[1])
        return left, shares, cost

    def _responses(self, winds: float, number: int, parts: tuple[str, ...]) -> tuple[Tensor, Tensor, list[str]]:
        """What the air makes of a body of a rate [F], what its own numbers multiply [P, F, k], and their names."""
        courses = self._endless if ENDLESS in parts else self._courses
        light = next((name for name in (SHADOWS, SKY_VIEW, ONE_LIGHT) if name in parts), None)
        courses = courses if light is None else self._lit(light)
        courses = courses[winds, number]
        names = ["start"]
        names += ["beam"] if "solar" in parts else []
        names += ["diffuse"] if "solar" in parts and ONE_LIGHT not in parts else []
        names += ["ground"] if "solar" in parts and ALBEDO in parts else []
        names += ["deep air"] if DEPTH in parts else []
        names += ["deep light"] if DEPTH in parts and "solar" in parts else []
        names += ["sky"] if "radiation" in parts else []
        basis = [(EXPECTED[name] * courses[name]).expand(len(self.values), -1) for name in names]
        basis += [EXPECTED["mirror"] * self._mirrored] if MIRRORED in parts else []
        return courses["air"], torch.stack(basis, 2), names

    @cached_property
    def _courses(self) -> dict[tuple[float, int], dict[str, Tensor]]:
        """Answers to air, light and sky at the frames' times by wind and rate, each [F] or [P, F]."""
        courses = {}
        for winds in WINDS:
            near, start = self._answers(self._drivers[0], self._exchange(winds), RATES_PER_S)
            deep, _ = self._answers(self._drivers[0], self._exchange(winds), [DEEPER * rate for rate in RATES_PER_S])
            for number in range(len(RATES_PER_S)):
                cores = {"deep air": deep[number, :, 0] - near[number, :, 0], "deep light": deep[number, :, 3]}
                courses[winds, number] = _named(near[number], start[number]) | cores
                if self._towards_ground is not None:
                    courses[winds, number]["ground"] = self._towards_ground[:, None] * near[number, :, 3]
        return courses

    @cached_property
    def _towards_ground(self) -> Tensor | None:
        """Share [P] of what surfaces face that lies below the horizon."""
        return None if self.normals is None else 0.5 * (1.0 - self.normals @ self.weather.up)

    def _lit(self, light: str) -> dict[tuple[float, int], dict[str, Tensor]]:
        """``_courses``, for the wind that there is, where SHADOWS are cast, or where beams and diffuse light are taken in one
        measure: ONE_LIGHT, or SKY_VIEW, where what stands around hides sky."""
        if light not in self._variants:
            weather = self.weather
            beams = self._drivers[0][:, BEAMS:]
            if light == SHADOWS:
                ways = felt_directions(weather, self.times_s.tolist())
                lit = lit_beside(self.tracks.points, self.around, ways)
                beams = beams * lit[:, (weather.sun @ ways.T).argmax(1)].T
            else:
                ways = sky_directions(SKY_PARTS, weather.up)
                facing = (self.normals @ ways.T).clamp_min(0.0)
                if light == SKY_VIEW:
                    facing = facing * lit_beside(self.tracks.points, self.around, ways)
                # Of an even sky a level surface takes all, a wall a half.
                beams = beams + self._drivers[0][:, 2:3] * facing.mean(1) / (weather.up @ ways.T).mean()
            drivers = torch.cat([self._drivers[0][:, :BEAMS], beams], 1)
            near, _ = self._answers(drivers, self._exchange(self.wind), RATES_PER_S)
            self._variants[light] = {
                (self.wind, number): self._courses[self.wind, number] | {"beam": near[number, :, BEAMS:].T}
                for number in range(len(RATES_PER_S))
            }
        return self._variants[light]

    @cached_property
    def _variants(self) -> dict[str, dict[tuple[float, int], dict[str, Tensor]]]:
        return {}

    @cached_property
    def _mirrored(self) -> Tensor:
        """By how much colder than the air what the points mirror looks [P, F], in kelvin."""
        weather, normals = self.weather, self.normals[:, None]
        air_k = kelvin(weather_record.at(weather, weather.air_c, self.times_s))
        sky_k = weather_record.at(weather, self._clouded_k if self.clouded else self._sky_k, self.times_s)
        sine = reflected(-self.tracks.directions, normals) @ weather.up
        emissivity = emissivity_towards(optical_depth((sky_k / air_k) ** 4), sine)
        return air_k * (emissivity**0.25 - 1.0)

    @cached_property
    def _endless(self) -> dict[tuple[float, int], dict[str, Tensor]]:
        """The same of bodies without an end by wind and a, the number in the place of their rate: means over bodies of one
        rate (``physics.responses.SemiInfiniteTable``), exact where the wind is steady."""
        octave = math.log(2.0)  # from one of RATES_PER_S to the next
        rates = [RATES_PER_S[-1] * 2.0**place for place in range(-OCTAVES, len(RATES_PER_S) + OCTAVES)]
        courses = {}
        for winds in WINDS:
            near, start = self._answers(self._drivers[0], self._exchange(winds), rates)
            for number, rate in enumerate(RATES_PER_S):
                distances = torch.tensor([math.log(other / rate) for other in rates], dtype=torch.float64)
                counts = semi_infinite_weights(distances, octave)
                courses[winds, number] = _named(torch.tensordot(counts, near, 1), counts @ start)
        return courses

    @cached_property
    def _drivers(self) -> tuple[Tensor, Tensor]:
        """Air in °C, then sky, diffuse and level light and beams in kelvin [T, d]; and wind over its mean [T]."""
        weather = self.weather
        zero = torch.zeros_like(weather.times_s)
        wind = zero + 1.0 if weather.wind_m_s is None else weather.wind_m_s / weather.wind_m_s.mean().clamp_min(0.1)
        light = zero if weather.irradiance_w_m2 is None else weather.irradiance_w_m2
        net = STEFAN_BOLTZMANN * (self._sky_k**4 - kelvin(weather.air_c) ** 4)
        beam, diffuse = light[:, None], zero
        if self.normals is not None and weather.direct_w_m2 is not None and weather.sun is not None:
            beam = weather.direct_w_m2[:, None] * (weather.sun @ self.normals.T).clamp_min(0.0)
            diffuse = zero if weather.diffuse_w_m2 is None else weather.diffuse_w_m2
        power = torch.cat([torch.stack([net, diffuse, light], 1), beam], 1) / EXCHANGE_W_M2_K
        return torch.cat([weather.air_c[:, None], power], 1), wind

    @cached_property
    def _sky_k(self) -> Tensor:
        return self._sky_under(0.0)

    @cached_property
    def _clouded_k(self) -> Tensor:
        return self._sky_k if self.weather.clouds is None else self._sky_under(self.weather.clouds)

    def _sky_under(self, clouds: Tensor | float) -> Tensor:
        humidity = self.weather.humidity_percent
        law = law_for("auto", humid=humidity is not None)
        return sky_temperature_k(kelvin(self.weather.air_c), humidity, law, clouds)

    def _exchange(self, winds: float) -> Tensor:
        """Exchange [T] with the air over that at mean wind, to which wind adds so much (WINDS)."""
        return (1.0 + winds * self._drivers[1]) / (1.0 + winds)

    def _answers(self, drivers: Tensor, exchange: Tensor, rates_per_s: Sequence[float]) -> tuple[Tensor, Tensor]:
        """u' = rate · gain · driver - rate · exchange · u at the frames' times [R, F, d], from rest; and the decay [R, F] from 1.

        Args:
            drivers: [T, d] as those of ``_drivers``.
            exchange: [T] as ``_exchange``.
            rates_per_s: R rates at the mean exchange.
        """
        times, rate = self.weather.times_s, torch.tensor(rates_per_s, dtype=torch.float64)[:, None]
        given = 0.5 * (exchange[1:] + exchange[:-1])
        seen = weather_record.remembered(times, given * min(rates_per_s), self.times_s)
        times, drivers, exchange, given = (
            times[seen],
            drivers[seen],
            exchange[seen],
            rate * given[seen][: len(times[seen]) - 1],
        )
        # Of long waves and light the body takes what it takes; wind changes how soon it gives that to the air.
        driven = torch.cat([exchange[:, None] * drivers[:, :1], drivers[:, 1:]], 1)
        # Nothing drives the decay.
        driven = torch.cat([0.5 * (driven[1:] + driven[:-1]), torch.zeros_like(driven[1:, :1])], 1)
        keep = torch.exp(-given * times.diff())
        over = rate * (1.0 - keep) / given
        rest = torch.cat([drivers[0, :1], drivers[0, 1:] / exchange[0], torch.ones(1, dtype=torch.float64)])
        state = rest.expand(len(rate), -1)
        above, share = weather_record.samples_around(times, self.times_s)
        found = state.new_zeros(len(rate), len(self.times_s), len(rest))
        for i in range(len(times) - 1):
            after = keep[:, i, None] * state + over[:, i, None] * driven[i]
            here = (above == i + 1).nonzero()[:, 0]
            if len(here):
                found[:, here] = torch.lerp(state[:, None], after[:, None], share[here, None])
            state = after
        return found[..., :-1], found[..., -1]


def _named(answers: Tensor, start: Tensor) -> dict[str, Tensor]:
    """Answers [F, d] to ``Weathered._drivers`` and the decay of the start [F] by name."""
    air, sky, diffuse, _ = answers[:, :BEAMS].unbind(1)
    return {"air": air, "sky": sky, "diffuse": diffuse, "beam": answers[:, BEAMS:].T, "start": start}
