"""Full balances of heat, with T⁴ and gusts as they are, fitted to scene points under a weather record.

Points follow their own balance within the noise where the record is right, three to ten times as closely as they do a balance
that is linear in its parameters. That tells what fair days hardly show.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from heatsplat.contracts import Weather
from heatsplat.effects.joint.held_out import FOLDS, WORST, fold_of
from heatsplat.physics.drivers import of_sky, of_sunlight, of_water
from heatsplat.physics.energy_balance import Climate
from heatsplat.physics.marching import march
from heatsplat.physics.responses import driver_means
from heatsplat.physics.surfaces import Core, Drivers, Surface
from heatsplat.physics.units import DAY_S, celsius, kelvin

# Of bodies with a core (``physics.marching.UNITS``): the limits of what has some, and what a number before its sigmoid, or as it
# is, is expected to be, with a standard deviation. A surface starts about its own mean, a core about the mean of the air.
LIMITS = {"share": (0.02, 0.98), "sun": (0.0, 200.0), "wind": (0.0, 0.95), "transpires": (0.0, 1.0)}
EXPECTED = {
    "start": (0.0, 10.0), "log_rate": (-math.log(3600.0), 1.5), "share": (-0.4, 1.0), "sun": (-2.2, 1.5), "wind": (-0.3, 1.0),
    "core_start": (0.0, 3.0), "core_log_rate": (-math.log(6 * 3600.0), 1.5), "log_coupling": (-0.7, 1.5),
    "transpires": (-3.0, 1.0),
}  # fmt: skip
FIRST_S = (1200.0, 7200.0)  # time constants from which fits start
STEPS, STEPS_ON = 12, 6  # of a fit, and of one that goes on from a fit to more observations
MODEL_K = 0.1  # by which such bodies err themselves
# Usual errors by which likely changes of a balance move temperatures: from SMALL on all points together see it, though no single
# one does; from LARGE on a balance is not known without. No more than WAYS of such changes are asked for.
SMALL, LARGE, WAYS = 0.05, 1.0, 6
ROBUST = 3.0  # expected errors from which an observation counts for less
MEMORY_S = 10.0 * DAY_S  # of the record before the first frame, after which starts no longer matter


@dataclass(frozen=True, eq=False)
class FullBalance:
    """P points in F frames as bodies with a core, under the air, light and wind of a record and a sky.

    The balance is that of ``thermal.energy_balance`` (ThermoGS, Eq. 2-5, with a sky), fitted as Levenberg (1944) and Marquardt
    (1963) do, under Huber's loss (1964) and with what is expected of its numbers.

    **Convention:** float64; series of the record are [T], linear between samples; a frame beyond its ends is at them.

    Args:
        weather: the record.
        sky_k: [T] temperature of its sky.
        times_s: [F] of the frames.
        values, errors, weights: [P, F] temperatures in °C, what errors are to be expected, and 0 where a point is not seen.
        normals: [P, 3] of the surface, or None: points lie level.
        film_mm: of the record's rain that stay on surfaces until they have evaporated; None: surfaces stay dry.
        transpires: whether dry surfaces evaporate a share of what wet ones do, each its own.
    """

    weather: Weather
    sky_k: Tensor
    times_s: Tensor
    values: Tensor
    errors: Tensor
    weights: Tensor
    normals: Tensor | None
    film_mm: float | None = None
    transpires: bool = False

    def without(self, name: str) -> FullBalance:
        """The same without "solar", "radiation" or "convection": in the dark, under a sky as warm as the air, or in a
        steady wind."""
        weather = self.weather
        if name == "radiation":
            return replace(self, sky_k=kelvin(weather.air_c))
        if name == "convection":
            return replace(self, weather=replace(weather, wind_m_s=torch.ones_like(weather.times_s)))
        light = ("irradiance_w_m2", "direct_w_m2", "diffuse_w_m2")
        given = {one: series for one in light if (series := getattr(weather, one)) is not None}
        return replace(
            self, weather=replace(weather, **{one: torch.zeros_like(series) for one, series in given.items()})
        )

    @cached_property
    def squares(self) -> Tensor:
        """Squares of ``left_out`` in those that are to be expected, [P, F], of single ones no more than WORST."""
        return (self.left_out**2 / self._variance).clamp(max=WORST)

    @cached_property
    def left_out(self) -> Tensor:
        """What balances err by at observations that they were not fitted to, [P, F] in kelvin."""
        whole = self._likeliest[0]
        fold, left = fold_of(*self.values.shape), torch.zeros_like(self.values)
        for k in range(FOLDS):
            found = self._fitted((self.weights > 0) & (fold != k), [whole], STEPS_ON)[1]
            left = torch.where(fold == k, self._above - found, left)
        return left

    @cached_property
    def unlikely(self) -> float:
        """Sum over the points of what fits make least, in squares of what is to be expected: errors at all observations, far ones
        no more than linear, and how far numbers are from those expected."""
        numbers, found = self._likeliest
        return float(self._unlikely(self.weights > 0, found, numbers).sum())

    def ways(self, most: int) -> Tensor | None:
        """In which ways the temperature of each point may go, [P, F, 1 + k] in kelvin about means over its observations; None
        where it may go in more.

        The first is that of its balance; the others are the directions in which likely changes of its numbers move that most: as
        many as move it by more than SMALL usual errors, and no more than ``most``.
        """
        numbers, _ = self._likeliest
        found, slopes = self._temperatures(numbers)
        used = (self.weights > 0).double()[..., None]
        ways = torch.cat([found[..., None], slopes * self._spread], 2)
        ways = ways - (ways * used).sum(1, keepdim=True) / used.sum(1, keepdim=True).clamp_min(1.0)
        _, sizes, directions = torch.linalg.svd(ways[..., 1:] * used, full_matrices=False)
        sizes = sizes.median(0).values / self.errors[self.weights > 0].median()
        if most < min(int((sizes > LARGE).sum()), WAYS):
            return None
        count = min(most, WAYS, int((sizes > SMALL).sum()))
        return torch.cat([ways[..., :1], ways[..., 1:] @ directions[:, :count].mT], 2)

    @cached_property
    def _likeliest(self) -> tuple[Tensor, Tensor]:
        """Likeliest numbers [P, Q] by all observations, and temperatures [P, F] of such bodies above the reference."""
        starts = [self._expected.clone() for _ in FIRST_S]
        for numbers, time_s in zip(starts, FIRST_S, strict=True):
            numbers[:, self._names.index("log_rate")] = -math.log(time_s)
        return self._fitted(self.weights > 0, starts, STEPS)

    @property
    def _variance(self) -> Tensor:
        return self.errors**2 + MODEL_K**2

    @property
    def _spread(self) -> Tensor:
        """Standard deviations [Q] of the numbers about what is expected of them."""
        return self.values.new_tensor([EXPECTED[name][1] for name in self._names])

    def _unlikely(self, used: Tensor, found: Tensor, numbers: Tensor) -> Tensor:
        """Squares of the errors of temperatures at ``used`` [P, F], far ones no more than linear (Huber), with those of the
        numbers, [P]."""
        missed = (self._above - found).abs() / self._variance.sqrt()
        squares = torch.where(missed < ROBUST, missed**2, 2.0 * ROBUST * missed - ROBUST**2)
        return (squares * used).sum(1) + (((numbers - self._expected) / self._spread) ** 2).sum(1)

    @cached_property
    def _climate(self) -> Climate:
        """The climate of the record, from ``MEMORY_S`` before the first frame."""
        weather = self.weather
        forgotten = int((weather.times_s < float(self.times_s.min()) - MEMORY_S).sum())
        kept = slice(min(max(forgotten - 1, 0), len(weather.times_s) - 2), None)
        reference_k = float(kelvin(driver_means(weather.times_s, weather.air_c)))
        drivers = {"air": kelvin(weather.air_c) - reference_k}
        drivers |= of_sunlight(weather, tilted=self.normals is not None)
        drivers |= of_sky(weather, self.sky_k, reference_k, tilted="beams" in drivers)
        drivers |= of_water(weather, self.film_mm, self.transpires)
        if weather.wind_m_s is not None and bool((weather.wind_m_s > 0).any()):
            drivers["wind_anomaly"] = weather.wind_m_s / driver_means(weather.times_s, weather.wind_m_s) - 1.0
        lasting = {name: drivers.pop(name) for name in ("up", "holds_mm") if name in drivers}
        series = {name: values[kept] for name, values in drivers.items()}
        return Climate(Drivers(weather.times_s[kept], reference_k, **series, **lasting))

    @cached_property
    def _names(self) -> list[str]:
        """Of the numbers of a body, in the order in which derivatives by them come."""
        drivers = self._climate.drivers
        absent = {"sun"} if drivers.light is None else set()
        absent |= {"wind"} if drivers.wind_anomaly is None else set()
        absent |= set() if self.transpires else {"transpires"}
        return [name for name in EXPECTED if name not in absent]

    @cached_property
    def _above(self) -> Tensor:
        """Temperatures [P, F] above the reference."""
        return self.values - celsius(self._climate.drivers.reference_k)

    @cached_property
    def _expected(self) -> Tensor:
        """Numbers [P, Q] that are expected of each body."""
        seen = self.weights > 0
        expected = self.values.new_tensor([EXPECTED[name][0] for name in self._names]).repeat(len(self.values), 1)
        expected[:, 0] = (self._above * seen).sum(1) / seen.sum(1).clamp_min(1)
        return expected

    def _temperatures(self, numbers: Tensor) -> tuple[Tensor, Tensor]:
        """Temperatures [P, F] above the reference of bodies of these numbers [P, Q], with derivatives by them [P, F, Q]."""
        found, slopes = {}, torch.ones_like(numbers)
        for place, name in enumerate(self._names):
            found[name] = numbers[:, place]
            if name in LIMITS:
                low, high = LIMITS[name]
                share = torch.sigmoid(numbers[:, place])
                found[name], slopes[:, place] = low + (high - low) * share, (high - low) * share * (1.0 - share)
        core = Core(found.pop("core_start"), found.pop("core_log_rate"), found.pop("log_coupling").exp())
        normals = None if self._climate.drivers.up is None else self.normals.double()
        surface = Surface(**{"sun": None} | found, normals=normals, core=core)
        record = self._climate.drivers.times_s  # beyond whose ends it says nothing
        moments, places = self.times_s.clamp(record[0], record[-1]).unique(return_inverse=True)
        marched = march(self._climate, surface, moments)[places].transpose(0, 1)
        return marched[..., 0], marched[..., 1:] * slopes[:, None]

    def _fitted(self, used: Tensor, starts: Sequence[Tensor], steps: int) -> tuple[Tensor, Tensor]:
        """Likeliest numbers [P, Q], and temperatures [P, F] of such bodies: Levenberg's and Marquardt's method, for each point
        from the best of the starts.

        Args:
            used: [P, F] observations that count.
        """
        spread, best = self._spread, None
        for numbers in starts:
            damping = torch.full_like(numbers[:, 0], 0.1)
            found, slopes = self._temperatures(numbers)
            cost = self._unlikely(used, found, numbers)
            for _ in range(steps):
                left = self._above - found
                counts = used / self._variance * (ROBUST * self._variance.sqrt() / left.abs()).clamp(max=1.0)
                inner = torch.einsum("pf,pfi,pfj->pij", counts, slopes, slopes) + torch.diag(spread**-2)
                pull = torch.einsum("pf,pfi,pf->pi", counts, slopes, left) - (numbers - self._expected) / spread**2
                held = inner + torch.diag_embed(damping[:, None] * inner.diagonal(dim1=1, dim2=2))
                moved = numbers + torch.linalg.solve(held, pull).clamp(-2.0 * spread, 2.0 * spread)
                there, steeper = self._temperatures(moved)
                costs = self._unlikely(used, there, moved)
                better = costs < cost
                numbers, found = (torch.where(better[:, None], *pair) for pair in ((moved, numbers), (there, found)))
                slopes, cost = torch.where(better[:, None, None], steeper, slopes), torch.where(better, costs, cost)
                damping = torch.where(better, 0.3 * damping, 5.0 * damping).clamp(1e-6, 1e4)
            if best is None:
                best = numbers, found, cost
            else:
                better = cost < best[2]
                numbers, found = (
                    torch.where(better[:, None], *pair) for pair in ((numbers, best[0]), (found, best[1]))
                )
                best = numbers, found, torch.minimum(cost, best[2])
        return best[:2]
