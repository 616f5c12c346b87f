"""Problems of heat, each with its equation for solvers, the product's own solutions, and a reference that shares no code.

Numbers are drawn as values of float32, so that no type is blamed for its input. The first two Gaussians of each draw have
the ends of the range of rates, and the reference is taken on the first Gaussians.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from benchmarks.stability.case import log_uniform, uniform
from benchmarks.stability.closed_form import CASES
from heatsplat.physics.energy_balance import Climate
from heatsplat.physics.fused import visible_temperature
from heatsplat.physics.marching import stepped_temperature
from heatsplat.physics.relaxation import harmonic_response, temperature
from heatsplat.physics.responses import ResponseTable, cubics, grid_position, interpolate, log_rate_grid
from heatsplat.physics.surfaces import Drivers, Surface, power_excess
from heatsplat.physics.units import DAY_S, STEFAN_BOLTZMANN

DIGITS = 50
AMBIENT_K = 290.0
REFERENCE_K = 288.0
SAMPLE_S = 600.0  # between two samples of weather
WEATHER_S = 2 * DAY_S
PRINTED = CASES[0].naive  # responses to sin and cos as ETGS prints them

# The temperatures [n] of all Gaussians at a moment.
Moment = Callable[[float], Tensor]


@dataclass(frozen=True)
class Form:
    """A solution that needs no time steps: it answers any moment by itself.

    Args:
        name, knob: which, and its setting for people ("" for none).
        type: "float32" or "float64".
        build: returns the function of a moment; what it does itself is done once for a record, and timed apart.
        ours: whether the product uses it.
    """

    name: str
    knob: str
    type: str
    build: Callable[[], Moment]
    ours: bool


@dataclass(frozen=True)
class Problem:
    """An initial value problem of N Gaussians that do not touch each other.

    Args:
        name, title: short, and for people.
        moments_s: frames [F], float64, above 0; the state is given at 0.
        kinks_s: moments within (0, last frame) at which drivers bend; solvers must step onto them.
        initial: [N] float64.
        equation: of a type; see ``Newton`` and ``Balance``.
        forms: the solutions without time steps in the types and for the table sizes asked for.
        reference: [S, F] float64 of the first S Gaussians; computed on the first call.
    """

    name: str
    title: str
    moments_s: tuple[float, ...]
    kinks_s: tuple[float, ...]
    initial: Tensor
    equation: Callable[[torch.dtype], Newton | Balance]
    forms: Callable[[tuple[str, ...], tuple[int, ...]], list[Form]]
    reference: Callable[[int], np.ndarray]


def problems(gaussians: int, frames: int, frequencies: int) -> dict[str, Callable[[], Problem]]:
    """What makes each problem, by name."""
    newton = partial(newton_problem, gaussians, frames)
    weather = partial(weather_problem, gaussians, frames)
    return {
        "cooling": partial(newton, "cooling", "Cooling", 0, (1e-5, 1e-1), (1.0, 1.0), 3600.0),
        "driven": partial(
            newton, "driven", f"Driven by {frequencies} harmonics, 2000 periods", frequencies, (1e-6, 1.0),
            (2 * math.pi / 4000, math.pi), 4000.0,
        ),
        "stiff": partial(
            newton, "stiff", "Stiff: rates 1e-9 to 1e4 1/s", frequencies, (1e-9, 1e4), (2 * math.pi / 4000, 0.1), 4000.0,
        ),
        "thin": partial(weather, "thin", "Stiff: grey bodies 10 nm to 1 m thick", 6 * 3600.0),
        "weather_linear": partial(weather, "weather_linear", "Two days of sun and air", WEATHER_S),
        "weather_full": partial(weather, "weather_full", "Two days of sun, air, wind, sky and T⁴", WEATHER_S),
    }  # fmt: skip


# ---- Newton's cooling with harmonic sources ----


class Newton:
    """dT/dt = a (T_ambient - T) + Σ_k gains_k · (sin ω_k t, cos ω_k t), in one type; phases in float64."""

    constant_rate = True

    def __init__(self, rate: Tensor, omega: Tensor, gains: Tensor, dtype: torch.dtype) -> None:
        self.rate, self.omega, self.gains = rate.to(dtype), omega, gains.flatten(1).to(dtype)
        self.moment, self.source = math.nan, torch.zeros_like(self.rate)

    def slope(self, t: float, x: Tensor) -> Tensor:
        """dT/dt, [N]; the source of the last moment is kept, since stages share moments."""
        if t != self.moment and len(self.omega):
            phase = self.omega * t
            self.moment, self.source = t, self.gains @ torch.cat((phase.sin(), phase.cos())).to(self.rate)
        return torch.addcmul(self.source, self.rate, AMBIENT_K - x)

    def decay(self, t: float, x: Tensor) -> Tensor:
        """Minus the derivative of the slope by x, [N]."""
        return self.rate


@dataclass(frozen=True)
class Bodies:
    """What ``Newton`` is asked of, and the solutions that need no time steps.

    Args:
        rate, initial: [N] float64.
        omega: [K] float64.
        gains: [N, 2, K] float64, of sin and of cos.
        rates: least and greatest rate, between which a table lies.
    """

    rate: Tensor
    initial: Tensor
    omega: Tensor
    gains: Tensor
    rates: tuple[float, float]

    def forms(self, types: tuple[str, ...], sizes: tuple[int, ...]) -> list[Form]:
        """The solutions in the types and for the table sizes asked for."""
        found = []
        for kind in types:
            dtype = getattr(torch, kind)
            found += [Form("closed form, fused kernel", "", kind, partial(self.fused, dtype), True)]
            found += [Form("closed form, torch", "", kind, partial(self.plain, dtype), True)]
            found += [Form("printed formula", "", kind, partial(self.printed, dtype), False)]
            found += [Form("rate table", f"{n} rates", kind, partial(self.table, dtype, n), False) for n in sizes]
        return found

    def printed(self, dtype: torch.dtype) -> Moment:
        a, w, g, first = (x.to(dtype) for x in (self.rate, self.omega, self.gains, self.initial))

        def at(t: float) -> Tensor:
            time = torch.tensor(t, dtype=dtype)
            sine, cosine = PRINTED(a[:, None], w, time)
            decayed = AMBIENT_K + (first - AMBIENT_K) * torch.exp(-time / (1 / a))
            return decayed + (g[:, 0] * sine + g[:, 1] * cosine).sum(1)

        return at

    def plain(self, dtype: torch.dtype) -> Moment:
        a, g, first = (x.to(dtype) for x in (self.rate, self.gains, self.initial))
        sin_gain, cos_gain = (x.contiguous() for x in g.unbind(1))
        ambient = torch.tensor(AMBIENT_K, dtype=dtype)
        return lambda t: temperature(
            torch.tensor(t, dtype=torch.float64), ambient, first, a, self.omega, sin_gain, cos_gain
        )

    def fused(self, dtype: torch.dtype) -> Moment:
        a, g, first = (x.to(dtype).contiguous() for x in (self.rate, self.gains, self.initial))
        source, ambient = g if len(self.omega) else None, torch.tensor(AMBIENT_K, dtype=dtype)
        return lambda t: visible_temperature(
            torch.tensor(t, dtype=torch.float64), ambient, first, a, self.omega, source
        )

    def table(self, dtype: torch.dtype, size: int) -> Moment:
        grid = log_rate_grid(size, *self.rates)
        cell, x = grid_position(self.rate.log(), grid)
        x, flat, first = x.to(dtype), self.gains.flatten(1).to(dtype), self.initial.to(dtype)

        def at(t: float) -> Tensor:
            responses = harmonic_response(grid.exp(), self.omega, torch.tensor(t, dtype=torch.float64))
            rows = torch.cat((torch.exp(-grid.exp() * t)[:, None], *responses), 1)
            found = interpolate(cubics(rows).to(dtype), cell, x)
            return AMBIENT_K + (first - AMBIENT_K) * found[:, 0] + (flat * found[:, 1:]).sum(1)

        return at

    def reference(self, moments_s: list[float], count: int) -> np.ndarray:
        """[count, F] float64 of the first bodies, by formula with many digits."""
        import mpmath

        values = np.empty((count, len(moments_s)))
        with mpmath.workdps(DIGITS):
            w = [mpmath.mpf(x) for x in self.omega.tolist()]
            turns = [[mpmath.expj(x * mpmath.mpf(t)) for x in w] for t in moments_s]
            for i in range(count):
                a, first = mpmath.mpf(self.rate[i].item()), mpmath.mpf(self.initial[i].item())
                pairs = zip(w, *self.gains[i].tolist(), strict=True)
                # Re of it times (e^{iωt} - e^{-at})
                terms = [mpmath.mpc(c, -s) / mpmath.mpc(a, x) for x, s, c in pairs]
                for f, t in enumerate(moments_s):
                    kept = mpmath.exp(-a * mpmath.mpf(t))
                    heat = sum((z * (turn - kept) for z, turn in zip(terms, turns[f], strict=True)), mpmath.mpc(0))
                    values[i, f] = AMBIENT_K + (first - AMBIENT_K) * kept + heat.real
        return values


def newton_problem(
    gaussians: int, frames: int, name: str, title: str, frequencies: int, rates: tuple, omegas: tuple, span_s: float
) -> Problem:
    """A problem of ``Newton``; each harmonic moves temperatures by up to some kelvin, whatever rate and frequency."""
    rate = log_uniform(f"{name} rate", *rates, gaussians)
    initial = uniform(f"{name} initial", 280.0, 340.0, gaussians)
    omega = torch.logspace(*(math.log10(w) for w in omegas), frequencies, dtype=torch.float64)
    amplitude = uniform(f"{name} gains", -2.0, 2.0, gaussians * 2 * frequencies).reshape(gaussians, 2, frequencies)
    gains = (amplitude * (rate[:, None, None] ** 2 + omega**2).sqrt()).float().double()
    if name == "stiff":  # some frames lie within the fastest bodies' settling
        moments = torch.logspace(-3, math.log10(span_s), frames, dtype=torch.float64).tolist()
    else:
        moments = torch.linspace(span_s / frames, span_s, frames, dtype=torch.float64).tolist()
    bodies = Bodies(rate, initial, omega, gains, rates)
    equation, reference = partial(Newton, rate, omega, gains), partial(bodies.reference, moments)
    return Problem(name, title, tuple(moments), (), initial, equation, bodies.forms, reference)


# ---- The balance of surfaces under the sky ----


class Balance:
    """dx/dt = r [g G + (1 - p)(1 + v b)(air - x) + p (s - w(x))] as in heatsplat.physics.energy_balance, in one type.

    Drivers are linear between samples. Of an interval, its start and its growth are kept: an integration meets it many times.
    """

    def __init__(self, surface: Surface, climate: Climate, dtype: torch.dtype) -> None:
        self.rate = surface.log_rate.exp().to(dtype)
        self.sun, self.share, self.wind, self.normals = (
            None if x is None else x.to(dtype) for x in (surface.sun, surface.share, surface.wind, surface.normals)
        )
        self.reference_k, self.times = climate.drivers.reference_k, climate.drivers.times_s.tolist()
        rows = climate.rows.to(dtype)
        self.air, self.wind_anomaly = climate.rows[0].tolist(), climate.rows[4].tolist()
        self.sky, self.around, self.light, self.beams = rows[1], rows[2], rows[3], rows[5:8]
        self.seen = None if self.normals is None else climate.share_of_sky(surface).to(dtype)
        self.interval = -1
        self.linear = self.share is None
        self.constant_rate = self.linear and self.wind is None
        self.convecting = 1.0 if self.linear else 1 - self.share

    def _forcing(self, k: int) -> Tensor:
        """All of the balance that knows neither x nor air, at sample k, [N]."""
        light = self.light[k] if self.seen is None else self.seen * self.light[k]
        if self.normals is not None:
            light = light + (self.normals @ self.beams[:, k]).clamp(min=0.0)
        heat = self.sun * light
        if not self.linear:
            sky = self.sky[k]
            if self.seen is not None:
                sky = self.around[k] + self.seen * (sky - self.around[k])
            heat = heat + self.share * sky
        return heat

    def _at(self, t: float) -> tuple[Tensor, float, float]:
        k = min(max(bisect_right(self.times, t) - 1, 0), len(self.times) - 2)
        if k != self.interval:
            start = self._forcing(k)
            self.interval, self.start, self.growth = k, start, self._forcing(k + 1) - start
        share = (t - self.times[k]) / (self.times[k + 1] - self.times[k])
        air, anomaly = (x[k] + share * (x[k + 1] - x[k]) for x in (self.air, self.wind_anomaly))
        return self.start + share * self.growth, air, anomaly

    def _exchange(self, anomaly: float) -> Tensor | float:
        return self.convecting if self.wind is None else self.convecting * (1 + anomaly * self.wind)

    def slope(self, t: float, x: Tensor) -> Tensor:
        """dx/dt, [N]."""
        heat, air, anomaly = self._at(t)
        heat = heat + self._exchange(anomaly) * (air - x)
        if not self.linear:
            heat = heat - self.share * power_excess(x, self.reference_k)
        return self.rate * heat

    def decay(self, t: float, x: Tensor) -> Tensor:
        """Minus the derivative of the slope by x, [N]."""
        if self.linear and self.wind is None:
            return self.rate
        steep = self._exchange(self._at(t)[2])
        if not self.linear:
            steep = steep + self.share * (1 + x / self.reference_k) ** 3
        return self.rate * steep


def weather(span_s: float, wind: bool, sky: bool) -> Drivers:
    """A made-up record from sunrise on: a day's course of sun and air with clouds, and wind in gusts."""
    times = torch.arange(0.0, span_s + SAMPLE_S, SAMPLE_S, dtype=torch.float64)
    noise = uniform("weather noise", -1.0, 1.0, 3 * len(times)).reshape(3, -1)
    day = 2 * math.pi * times / DAY_S
    air = 2.0 + 7.0 * torch.sin(day - 0.6) + 0.3 * noise[0]
    height = torch.sin(day) * 0.85  # of the sun: sine of its elevation, over 0 in the first half of each day
    level = (1 - height**2).sqrt()
    sun = torch.stack((level * day.cos(), -level * day.sin() * 0.4, height), 1)
    sun = sun / sun.norm(dim=1, keepdim=True)
    clear = (sun[:, 2] > 0) * (0.75 + 0.25 * noise[1])
    sky_k = REFERENCE_K + air - 18.0 + 2.0 * noise[0]
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return Drivers(
        times,
        REFERENCE_K,
        air,
        sky=power_excess(sky_k - REFERENCE_K, REFERENCE_K) if sky else None,
        around=power_excess(air, REFERENCE_K) if sky else None,
        light=0.12 * sun[:, 2].clamp(min=0.0),
        beams=(0.85 * clear * sun[:, 2].clamp(min=0.0) ** 0.3)[:, None] * sun,
        wind_anomaly=0.4 * noise[2] + 0.3 * torch.sin(3 * day) if wind else None,
        up=up,
    )


def weather_problem(gaussians: int, frames: int, name: str, title: str, span_s: float) -> Problem:
    """A problem of ``Balance``: rates of 10 seconds to 4 months, or thin sheets of given matter."""
    full = name != "weather_linear"
    drivers = weather(span_s, wind=name == "weather_full", sky=full)
    directions = torch.stack([uniform(f"{name} {axis}", -1.0, 1.0, gaussians) for axis in "xyz"], 1)
    normals = directions / directions.norm(dim=1, keepdim=True)
    rate = log_uniform(f"{name} rate", 1e-7, 0.1, gaussians)
    sun, share = uniform(f"{name} sun", 5.0, 60.0, gaussians), uniform(f"{name} share", 0.1, 0.9, gaussians)
    if name == "thin":
        thick = log_uniform("thickness", 1e-8, 1.0, gaussians)
        radiating = 4 * 0.95 * STEFAN_BOLTZMANN * REFERENCE_K**3
        exchange = 10.0 + radiating  # W/(m² K): wind at 1 m/s beside radiation
        rate = exchange / (2e6 * thick)  # matter of 2 MJ/(m³ K)
        sun, share = torch.full_like(rate, 700.0 / exchange), torch.full_like(rate, radiating / exchange)
    surface = Surface(
        start=uniform(f"{name} start", -10.0, 20.0, gaussians),
        log_rate=rate.log().float().double(),
        sun=sun,
        share=share.float().double() if full else None,
        wind=uniform("wind", 0.1, 0.9, gaussians) if name == "weather_full" else None,
        normals=normals.float().double(),
    )
    climate = Climate(drivers)
    gap = span_s / frames
    moments = tuple(gap * (f + 0.5) + 0.37 * SAMPLE_S for f in range(frames))  # not on samples
    kinks = tuple(t for t in drivers.times_s.tolist() if 0 < t < moments[-1])

    def cast(kind: str) -> Surface:
        return Surface(*(x.to(getattr(torch, kind)) if isinstance(x, torch.Tensor) else x for x in surface))

    def stepped(kind: str) -> Moment:
        own, record = cast(kind), Climate(drivers)
        return lambda t: stepped_temperature(record, own, t)

    def tabulated(kind: str, size: int) -> Moment:
        own, record = cast(kind), Climate(drivers)
        record.table = ResponseTable(record.table.times_s, record.table.drivers, log_rate_grid(size))

        def at(t: float) -> Tensor:
            record.table._tables.clear()  # a frame's table is paid for in each round
            return record.linear_temperature(own, t)

        return at

    def forms(types: tuple[str, ...], sizes: tuple[int, ...]) -> list[Form]:
        found = []
        for kind in types:
            found.append(Form("balance, time-stepped kernel", "", kind, partial(stepped, kind), True))
            if name != "thin":  # the tables end at time constants of one second
                tables = (Form("rate table", f"{n} rates", kind, partial(tabulated, kind, n), True) for n in sizes)
                found += tables
        return found

    def reference(count: int) -> np.ndarray:
        return (
            linear_truth(surface, climate, moments, count)
            if not full
            else stiff_truth(surface, climate, moments, count)
        )

    return Problem(name, title, moments, kinks, surface.start, partial(Balance, surface, climate), forms, reference)


def _light(surface: Surface, climate: Climate, count: int) -> np.ndarray:
    """Sunlight [count, T] on the first surfaces at the samples."""
    drivers, normals = climate.drivers, surface.normals[:count].numpy()
    seen = 0.5 * (1 + normals @ drivers.up.numpy())
    return seen[:, None] * drivers.light.numpy() + np.maximum(normals @ drivers.beams.numpy().T, 0.0)


def linear_truth(surface: Surface, climate: Climate, moments: tuple[float, ...], count: int) -> np.ndarray:
    """Exact temperatures [count, F] of the first surfaces without radiation and wind, in 50 digits."""
    import mpmath

    times, air, light = climate.drivers.times_s.tolist(), climate.drivers.air.tolist(), _light(surface, climate, count)
    values = np.empty((count, len(moments)))
    with mpmath.workdps(DIGITS):
        for i in range(count):
            r, g = mpmath.exp(mpmath.mpf(surface.log_rate[i].item())), mpmath.mpf(surface.sun[i].item())
            x, u = (
                mpmath.mpf(surface.start[i].item()),
                [mpmath.mpf(a) + g * s for a, s in zip(air, light[i].tolist(), strict=True)],
            )
            f = 0
            for k in range(len(times) - 1):
                slope = (u[k + 1] - u[k]) / (mpmath.mpf(times[k + 1]) - mpmath.mpf(times[k]))

                def later(seconds, x=x, begin=u[k], slope=slope, r=r):
                    return begin + slope * (seconds - 1 / r) + (x - begin + slope / r) * mpmath.exp(-r * seconds)

                while f < len(moments) and moments[f] <= times[k + 1]:
                    values[i, f] = later(mpmath.mpf(moments[f]) - mpmath.mpf(times[k]))
                    f += 1
                if f == len(moments):
                    break
                x = later(mpmath.mpf(times[k + 1]) - mpmath.mpf(times[k]))
    return values


def stiff_truth(surface: Surface, climate: Climate, moments: tuple[float, ...], count: int) -> np.ndarray:
    """Temperatures [count, F] of the first surfaces by LSODA (scipy) at tolerances of 1e-12, restarted at every sample."""
    from scipy.integrate import odeint

    drivers, light = climate.drivers, _light(surface, climate, count)
    times, air = drivers.times_s.numpy(), drivers.air.numpy()

    def first(x: Tensor | None) -> np.ndarray:
        return np.zeros(count) if x is None else x[:count].numpy()

    rate, sun, share, wind = (
        np.exp(first(surface.log_rate)),
        first(surface.sun),
        first(surface.share),
        first(surface.wind),
    )
    seen = 0.5 * (1 + surface.normals[:count].numpy() @ drivers.up.numpy())
    sky, around, anomaly = (
        np.zeros_like(air) if x is None else x.numpy() for x in (drivers.sky, drivers.around, drivers.wind_anomaly)
    )
    heat = (sun[:, None] * light + share[:, None] * (seen[:, None] * sky + (1 - seen[:, None]) * around)).T
    cubed = 4 * drivers.reference_k**3

    def between(k: int, t: float) -> tuple:
        s = (t - times[k]) / (times[k + 1] - times[k])
        return (
            heat[k] + s * (heat[k + 1] - heat[k]),
            air[k] + s * (air[k + 1] - air[k]),
            anomaly[k] + s * (anomaly[k + 1] - anomaly[k]),
        )

    def slope(x, t, k):
        q, a, b = between(k, t)
        radiated = ((drivers.reference_k + x) ** 4 - drivers.reference_k**4) / cubed
        return rate * (q + (1 - share) * (1 + wind * b) * (a - x) - share * radiated)

    def jacobian(x, t, k):
        b = between(k, t)[2]
        return -(rate * ((1 - share) * (1 + wind * b) + share * 4 * (drivers.reference_k + x) ** 3 / cubed))[None]

    x, values, f = first(surface.start), np.empty((count, len(moments))), 0
    for k in range(len(times) - 1):
        inside = [t for t in moments if times[k] < t <= times[k + 1]]
        stops = np.unique([times[k], *inside, times[k + 1]])
        found = odeint(
            slope, x, stops, args=(k,), Dfun=jacobian, ml=0, mu=0, rtol=1e-12, atol=1e-12, mxstep=100_000
        )  # fmt: skip
        for t in inside:
            values[:, f] = found[np.searchsorted(stops, t)]
            f += 1
        if f == len(moments):
            return values
        x = found[-1]
    return values
