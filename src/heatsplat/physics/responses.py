"""Responses of bodies that relax at a rate to drivers that are linear between the samples of a record.

A body that exchanges heat at the rate a follows a driver u by Y(a, t) = a ∫ e^{-a(t-s)} u(s) ds, the settled response: it
has the unit of the driver and tends to u(t) for fast bodies. It depends on one number per body, so it is tabulated once per
moment on a grid of log rates, in float64 by the exact recursion

    Y(t + Δ) = E Y(t) + (φ - E) u(t) + (1 - φ) u(t + Δ),   E = e^{-aΔ},   φ = (1 - E) / (aΔ),

and interpolated per body by cubics in log a (bodies without an end: ``SemiInfiniteTable``). Any record then costs a few
multiply-adds per body, however long it is. (A state of its own at the first sample only adds that state times e^{-at}.)

**Error:** 1 mK at drivers of 50 K against a stiff solver over two days of weather, most of it the solver's.

**Convention:** times in float64 seconds, rates in 1/s; the response is 0 at the first sample.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

LOWEST_RATE, HIGHEST_RATE = 1e-8, 1.0  # 1/s: time constants from 3 years to a second
RATES = 129  # the cubics then err by 2e-5 of the driver's range over two days of weather (65: 3e-4)
_BEYOND = 24.0  # on each side of the grid, in log rate: less than 1e-5 of a semi-infinite body lies farther out
MOMENTS_KEPT = 4096  # tables of this many moments stay in memory: 50 MB for six drivers


def log_rate_grid(count: int = RATES, lowest: float = LOWEST_RATE, highest: float = HIGHEST_RATE) -> Tensor:
    """Natural logarithms of rates, [count] float64, evenly spaced."""
    return torch.linspace(math.log(lowest), math.log(highest), count, dtype=torch.float64)


def step_weights(rates: Tensor, seconds: Tensor | float) -> tuple[Tensor, Tensor, Tensor]:
    """E, φ - E and 1 - φ of the recursion over ``seconds``; they add up to one. Broadcasts; float64, for digits' sake."""
    y = rates * seconds
    decay = torch.exp(-y)
    phi = torch.where(y > 0, -torch.expm1(-y) / torch.where(y > 0, y, 1.0), 1.0)
    return decay, phi - decay, 1 - phi


def driver_means(times_s: Tensor, drivers: Tensor) -> Tensor:
    """Means over time, [...], of drivers [T, ...] that are linear between samples at times [T]."""
    return torch.trapezoid(drivers.movedim(0, -1), times_s, dim=-1) / (times_s[-1] - times_s[0])


def interval_of(times_s: Tensor, time_s: float) -> tuple[int, float]:
    """Number k of the interval of a record that holds a moment, and the seconds since sample k."""
    k = int(torch.searchsorted(times_s, time_s, right=True).clamp(1, len(times_s) - 1)) - 1
    return k, time_s - float(times_s[k])


class ResponseTable:
    """Settled responses to the drivers of a record on a grid of rates.

    Args:
        times_s: [T] float64, increasing.
        drivers: [T, J], any unit.
        log_rates: [A] from ``log_rate_grid``.
    """

    def __init__(self, times_s: Tensor, drivers: Tensor, log_rates: Tensor | None = None) -> None:
        self.times_s, self.drivers = times_s, drivers.to(torch.float64)
        self.log_rates = log_rate_grid() if log_rates is None else log_rates
        self._rates = self.log_rates.exp()[:, None]
        states = [self.drivers.new_zeros(len(self._rates), drivers.shape[1])]
        for k, seconds in enumerate(times_s.diff().tolist()):
            states.append(self._advance(states[-1], k, seconds, self.drivers[k + 1]))
        self._states = torch.stack(states)
        self._tables: dict[float, Tensor] = {}

    def _advance(self, state: Tensor, k: int, seconds: float, end: Tensor) -> Tensor:
        decay, before, after = step_weights(self._rates, seconds)
        return decay * state + before * self.drivers[k] + after * end

    def exact(self, time_s: float) -> Tensor:
        """Responses at a moment of the record on the grid of rates, [A, J] float64."""
        k, seconds = interval_of(self.times_s, time_s)
        end = torch.lerp(self.drivers[k], self.drivers[k + 1], seconds / float(self.times_s[k + 1] - self.times_s[k]))
        return self._advance(self._states[k], k, seconds, end)

    def at(self, time_s: float) -> Tensor:
        """Coefficients of the cubics at a moment of the record, [A - 3, 4, J] float64, for ``interpolate``."""
        if time_s not in self._tables:
            if len(self._tables) >= MOMENTS_KEPT:
                self._tables.clear()
            self._tables[time_s] = cubics(self.exact(time_s))
        return self._tables[time_s]


class SemiInfiniteTable(ResponseTable):
    """Responses of bodies without an end behind a surface that exchanges heat, such as massive walls and ground.

    Of effusivity b = √(k ρ c) and exchange H such a body follows a driver u by u / (1 + √(s / a)) (Laplace), a = (H / b)²:
    it settles like 1 - e^{at} erfc √(at) (Carslaw and Jaeger, Conduction of Heat in Solids, 2.7). That is a mean of the
    responses of bodies of one rate, over all rates, with density 1 / (2π cosh(x / 2)) where x is the logarithm of their rate
    over a (its Stieltjes integral): nothing but the table of those is needed. The integral is a sum over an even grid, whose
    error is exponentially small; what lies beyond its ends counts at them.

    Args: as ``ResponseTable``; the rates of the table are those a.
    """

    def __init__(self, times_s: Tensor, drivers: Tensor) -> None:
        grid = log_rate_grid()
        step = float(grid[1] - grid[0])
        beyond = round(_BEYOND / step)
        wide = grid[0] + step * torch.arange(-beyond, len(grid) + beyond, dtype=torch.float64)
        super().__init__(times_s, drivers, wide)
        self.log_rates = grid
        self._weights = semi_infinite_weights(wide - grid[:, None], step)

    def exact(self, time_s: float) -> Tensor:
        return self._weights @ super().exact(time_s)


def semi_infinite_weights(distances: Tensor, step: float) -> Tensor:
    """How much bodies of one rate count in a semi-infinite one, [..., Q], adding up to one.

    Args:
        distances: [..., Q] logarithms of their rates over a, rising evenly by ``step``.
    """
    weights = step / (2 * math.pi * torch.cosh(0.5 * distances))
    for end, sign in ((0, -1), (-1, 1)):  # beyond half a step from the end, 2/π arctan e^{-x/2}
        outside = sign * distances[..., end] + 0.5 * step
        weights[..., end] += 2 / math.pi * torch.atan(torch.exp(-0.5 * outside))
    return weights


def cubics(values: Tensor) -> Tensor:
    """Coefficients [A - 3, 4, ...] of the cubics through four neighbours each of values [A, ...] on an even grid.

    Cubic i holds between nodes i + 1 and i + 2 (and out to the ends of the grid), in the coordinate that counts grid steps
    from node i + 1.
    """
    a, b, c, d = values[:-3], values[1:-2], values[2:-1], values[3:]
    linear = -a / 3 - b / 2 + c - d / 6
    square = (a + c) / 2 - b
    cube = (d - a) / 6 + (b - c) / 2
    return torch.stack((b, linear, square, cube), dim=1)


def grid_position(log_rates: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
    """Cubic [n] int64 and coordinate in it [n] of log rates [n], which are limited to the ends of the grid."""
    low, high, count = float(grid[0]), float(grid[-1]), len(grid)
    position = (log_rates.clamp(low, high) - low) * ((count - 1) / (high - low))
    cell = (position.detach().long() - 1).clamp(0, count - 4)
    return cell, position - (cell + 1).to(position)


def interpolate(coefficients: Tensor, cell: Tensor, coordinate: Tensor) -> Tensor:
    """Responses [n, J] at the position that ``grid_position`` gives; differentiable by the coordinate."""
    rows = coefficients.index_select(0, cell)
    x = coordinate[:, None]
    return rows[:, 0] + x * (rows[:, 1] + x * (rows[:, 2] + x * rows[:, 3]))
