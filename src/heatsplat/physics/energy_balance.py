"""Temperature of surfaces under the sky in closed form: sun, air, wind and the sky's long waves, for any weather record.

Per unit area of a surface with heat capacity C (volumetric capacity times depth),

    C dT/dt = α G(t) + h(t) (T_air(t) - T) + e σ (T_sky(t)⁴ - T⁴),    h(t) proportional to 1 - v + v wind(t) / mean wind.

Multiplying α, h, e and C by one number changes nothing, so that only ratios can be known. With the reference temperature R
and the total conductance H = h + 4 e σ R³ (at mean wind) they are, each with a meaning of its own,

    r = H / C         rate in 1/s; the time constant is about 1/r          seen in how temperature lags and is damped
    g = α / H         kelvin that sunlight of 1 kW/m² heats                 seen by day
    p = 4 e σ R³ / H  share of the exchange that radiates, in (0, 1)        seen at night, in K below the air
    v                 share of convection that wind causes, in (0, 1)       seen when wind changes by day

and in kelvin above the reference, x = T - R, with w(x) = (T⁴ - R⁴) / (4 R³) and s the same of the sky,

    dx/dt = r [g G + (1 - p)(1 + v b)(air - x) + p (s - w(x))],    b = wind / mean wind - 1.

``linear_temperature`` replaces w by its tangent at the surface's own mean temperature and v b x by v b times that mean,
which leaves one rate per surface and so the response tables (responses.py, sunlight.py): its cost does not depend on the
record. heatsplat.physics.marching solves the equation as it stands, along the record.

A body with depth has a core behind its surface, which only the surface heats (two nodes):

    dx/dt = r [... + κ (y - x)],    dy/dt = μ (x - y),

with κ the conductance between them over H and μ that conductance over the capacity of the core. With the stiffness s that
linearising leaves, both relax at two rates a₁ > μ > a₂, and x is a mean of the responses of one node at those rates: two
looks at the same tables, nothing is stepped.

A body without an end (massive wall, ground) takes the heat in by its effusivity b = √(k ρ c), and a = (H / b)² in 1/s stands
in the place of r: it follows the same drivers, through the table of ``responses.SemiInfiniteTable``.

Water evaporates with that exchange: air - x becomes air - x - m (L ρ_sat(x) - L ρ_v), with m the share of a wet surface's
evaporation. Rain wets surfaces for as long as it takes to evaporate at their own temperature, and plants transpire with a share
of their own where they are dry (heatsplat.physics.wetness).

A constant heat q from within (a heated room behind a wall) adds f = q / H, in kelvin, to the drivers. Where the temperature ρ
of that room is known (above the reference), heat comes of it by a constant conductance instead, f (1 - x/ρ) with f what it
is at x = 0: a light wall lets out a tenth more by night than in the mean of the day. Heat that goes the other way (ground)
stays constant.

**Convention:** kelvin above the reference, kW/m², seconds; every driver is linear between its samples.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from heatsplat.derivatives import once_differentiable
from heatsplat.physics.responses import (
    ResponseTable,
    SemiInfiniteTable,
    driver_means,
    grid_position,
    interpolate,
    semi_infinite_weights,
)
from heatsplat.physics.sunlight import Seen, SunlightTable
from heatsplat.physics.surfaces import Core, Drivers, Surface, power_excess

NEWTON_STEPS = 5  # from the linear balance: the mean temperature is then exact in float32
MIN_STIFFNESS = 0.05  # of a / r, where a trained share of 1 and a cold mean could let it vanish
_BEAM_RATES, _FARTHEST = 20, 14.0  # of the sun on semi-infinite bodies: how many, and how far from a in log rate
_FAR = 50.0  # of erfcx: from here on four terms of its series
HALF_RANGE_K = 150.0  # means farther from the reference than this are no surfaces under a sky


class Climate:
    """A record of drivers with its tables: all that the temperature of a surface needs beside its own parameters.

    Args:
        drivers: the record.
        semi_infinite: bodies have no end; log rates are those of a.
    """

    def __init__(self, drivers: Drivers, semi_infinite: bool = False) -> None:
        self.drivers, self.semi_infinite = drivers, semi_infinite
        zero = torch.zeros_like(drivers.air)
        columns = {"air": drivers.air, "light": drivers.light, "sky": drivers.sky, "around": drivers.around}
        columns |= {"ground": drivers.ground}
        self.wind_anomaly_mean = 0.0
        if drivers.wind_anomaly is not None:
            self.wind_anomaly_mean = float(driver_means(drivers.times_s, drivers.wind_anomaly))
            gusts = drivers.wind_anomaly - self.wind_anomaly_mean
            columns |= {"gusts": gusts, "gusts_air": gusts * drivers.air}
        columns = {name: series for name, series in columns.items() if series is not None}
        self.columns = {name: j for j, name in enumerate(columns)}
        series = torch.stack(list(columns.values()), dim=1)
        self._series = series
        self.means = driver_means(drivers.times_s, series).float()
        rows = [columns.get(name, zero) for name in ("air", "sky", "around", "light")]
        rows += [zero if drivers.wind_anomaly is None else drivers.wind_anomaly]
        rows += list(torch.zeros(3, len(zero), dtype=torch.float64) if drivers.beams is None else drivers.beams.T)
        rows.append(zero if drivers.ground is None else drivers.ground)
        rows += [zero if series is None else series for series in (drivers.vapour, drivers.rain, drivers.dries)]
        self.rows = torch.stack(rows).contiguous()
        self.slots = torch.zeros(len(zero), dtype=torch.int64)
        if drivers.ways is not None:
            self.slots = (drivers.beams @ drivers.ways.T).argmax(1)

    # Tables of long records take seconds and gigabytes, and a balance that is marched reads none.
    @cached_property
    def table(self) -> ResponseTable:
        """Responses of bodies of any rate to each column."""
        return (SemiInfiniteTable if self.semi_infinite else ResponseTable)(self.drivers.times_s, self._series)

    @cached_property
    def beam(self) -> SunlightTable | None:
        """What surfaces of any slope take of the direct sun; None without."""
        return None if self.drivers.beams is None else SunlightTable(self.drivers.times_s, self.drivers.beams)

    def share_of_sky(self, surface: Surface) -> Tensor | float:
        """Share of what a surface sees that is sky, [n]: (1 + n · up) / 2 of what is open."""
        if surface.normals is None:
            return 1.0
        share = 0.5 * (1 + surface.normals @ self.drivers.up.to(surface.normals))
        return share if surface.exposure.sky is None else share * surface.exposure.sky

    def _seen(self, surface: Surface) -> Seen | None:
        """What surfaces see of the sun, None for all of it."""
        sun = surface.exposure.sun
        return None if sun is None else Seen(sun, self.drivers.ways, self.slots)

    def forcing(self, surface: Surface, values: Tensor, beam: Tensor | float, mean: Tensor | float) -> Tensor:
        """What a surface would settle at, times a / r without radiation's constant: drivers with their weights, [n].

        Args:
            values: [n, J] or [J] of the drivers in ``columns``.
            beam: of the sun's beam on the surface, [n].
            mean: temperature at which wind acts, [n].
        """
        take = {name: values[..., j] for name, j in self.columns.items()}
        sky = self.share_of_sky(surface)
        convection = self._convection(surface)
        total = take["air"] if convection is None else convection * take["air"]
        if surface.sun is not None:
            lit = beam + sky * take["light"] if "light" in take else beam
            total = surface.sun * (lit + (1 - sky) * take["ground"] if "ground" in take else lit) + total
        if surface.wind is not None:
            gusty = surface.wind if surface.share is None else (1 - surface.share) * surface.wind
            total = total + gusty * (take["gusts_air"] - mean * take["gusts"])
        if surface.share is not None:
            seen = sky * take["sky"] + (1 - sky) * take["around"] if "around" in take else take["sky"]
            total = total + surface.share * seen
        return total

    def _convection(self, surface: Surface) -> Tensor | None:
        """(1 - p)(1 + v times the mean of b over this record); None where neither sky nor wind takes part, and it is 1."""
        calm = None if surface.share is None else 1 - surface.share
        if surface.wind is None:
            return calm
        windy = 1 + surface.wind * self.wind_anomaly_mean
        return windy if calm is None else calm * windy

    def _leak(self, surface: Surface) -> Tensor | None:
        """Conductance to the room over H, [n]; None where heat from within is constant."""
        room = self.drivers.room
        return None if surface.inner is None or room is None else (surface.inner / room).clamp(min=0.0)

    def _stiffness(self, surface: Surface) -> Tensor | None:
        """``_convection`` with what leaks from the room; None where neither is there, and it is 1."""
        convection, leak = self._convection(surface), self._leak(surface)
        if leak is None:
            return convection
        return leak + (1.0 if convection is None else convection)

    def mean_heat_from_within(self, surface: Surface) -> Tensor:
        """Mean of the record of q / H in kelvin, [n]; of surfaces with heat from within."""
        leak = self._leak(surface)
        return surface.inner if leak is None else surface.inner - leak * self.mean_temperature(surface)

    def mean_temperature(self, surface: Surface) -> Tensor:
        """The temperature x at which the mean balance of the record is even, [n]; differentiable.

        Newton's method on a function that rises with x; its last step carries the derivatives (implicit function).
        """
        beam = 0.0 if self.beam is None else self.beam.mean(surface.normals).to(surface.log_rate)
        seen = self._seen(surface)
        if seen is not None:
            beam = beam * seen.mean(surface.normals)
        means = self.means.to(surface.log_rate)
        if surface.share is None:
            forced, stiffness = self.forcing(surface, means, beam, 0.0), self._stiffness(surface)
            forced = forced if surface.inner is None else forced + surface.inner
            return forced if stiffness is None else forced / stiffness

        def step(x: Tensor, surface: Surface) -> Tensor:
            stiffness = self._stiffness(surface)
            slope = stiffness.detach() + surface.share.detach() * (1 + x.detach() / self.drivers.reference_k) ** 3
            radiated = surface.share * power_excess(x, self.drivers.reference_k)
            forced = self.forcing(surface, means, beam, 0.0)
            forced = forced if surface.inner is None else forced + surface.inner
            rest = forced - stiffness * x - radiated
            return (x + rest / slope.clamp(min=MIN_STIFFNESS)).clamp(-HALF_RANGE_K, HALF_RANGE_K)

        with torch.no_grad():
            x = surface.share * 0.0
            for _ in range(NEWTON_STEPS):
                x = step(x, surface)
        return step(x, surface)

    def linear_temperature(self, surface: Surface, time_s: float) -> Tensor:
        """Temperature x at a moment of the record with T⁴ and wind linearised about the surface's own mean, [n]."""
        return self.linear_course(surface)(time_s)

    def linear_course(self, surface: Surface) -> Callable[[float], Tensor]:
        """What gives ``linear_temperature`` at any moment, about one mean."""
        stiffness = self._stiffness(surface)
        mean, constant = 0.0 if stiffness is None else self.mean_temperature(surface), surface.inner
        if surface.share is not None:
            steep = (1 + mean / self.drivers.reference_k) ** 3
            bent = surface.share * (steep * mean - power_excess(mean, self.drivers.reference_k))
            constant = bent if constant is None else constant + bent
            stiffness = (stiffness + surface.share * steep).clamp(min=MIN_STIFFNESS)
        log_rate, rates = surface.log_rate, None
        if surface.core is not None:
            rates = _two_rates(surface.core, surface.log_rate, 1.0 if stiffness is None else stiffness)
        elif stiffness is not None:  # a holds the square of H
            log_rate = log_rate + (2 * stiffness.log() if self.semi_infinite else stiffness.log())

        def response(time_s: float, log_rate: Tensor) -> tuple[Tensor, Tensor]:
            """What a body of this one rate follows, before it is divided by its stiffness, and what it keeps of its start."""
            elapsed = time_s - float(self.drivers.times_s[0])
            settled = interpolate(self.table.at(time_s).to(log_rate), *grid_position(log_rate, self.table.log_rates))
            beam = 0.0 if self.beam is None else self._beam(time_s, surface, log_rate).to(log_rate)
            if self.semi_infinite:
                kept = _Erfcx.apply(torch.exp(0.5 * log_rate) * elapsed**0.5)
            else:
                kept = torch.exp(-log_rate.exp() * elapsed)
            forced = self.forcing(surface, settled, beam, mean)
            return forced if constant is None else forced + constant * (1 - kept), kept

        def at(time_s: float) -> Tensor:
            if rates is None:
                forced, kept = response(time_s, log_rate)
                left = surface.start * kept
            else:
                (fast, fast_kept), (slow, slow_kept) = (response(time_s, rate) for rate in rates.log_rates)
                forced = slow + rates.share * (fast - slow)
                left = surface.start * (slow_kept + rates.own * (fast_kept - slow_kept))
                left = left + surface.core.start * rates.of_core * (slow_kept - fast_kept)
            return left + (forced if stiffness is None else forced / stiffness)

        return at

    def _beam(self, time_s: float, surface: Surface, log_rate: Tensor) -> Tensor:
        """Response [n] to the sun's beam; that of a semi-infinite body from so few rates that 0.3 % of it are missed."""
        normals, seen = surface.normals, self._seen(surface)
        if not self.semi_infinite:
            return self.beam.response(time_s, normals, log_rate, seen)
        distances = torch.linspace(-_FARTHEST, _FARTHEST, _BEAM_RATES, dtype=torch.float64)
        weights = semi_infinite_weights(distances, 2 * _FARTHEST / (_BEAM_RATES - 1)).tolist()
        rates = (log_rate + distance for distance in distances.tolist())
        return sum(
            weight * self.beam.response(time_s, normals, rate, seen)
            for weight, rate in zip(weights, rates, strict=True)
        )


class _Erfcx(torch.autograd.Function):
    """What a semi-infinite body keeps of its start, e^{x²} erfc(x) of any shape, with a slope that keeps its digits.

    The slope is 2 x erfcx(x) - 2/√π, of which 1/(2 x²) is left where x is large: float64 and, from ``_FAR`` on, the asymptotic
    series lose no more than 1e-12 of it.
    """

    @staticmethod
    def forward(ctx, x: Tensor) -> Tensor:
        at = x.detach().double()
        kept = torch.special.erfcx(at)
        ctx.save_for_backward(at, kept)
        return kept.to(x)

    @staticmethod
    @once_differentiable
    def backward(ctx, v_kept: Tensor) -> Tensor:
        at, kept = ctx.saved_tensors
        near = 2 * at * kept - 2 / math.pi**0.5
        y = at**-2
        far = -y / math.pi**0.5 * (1 - y * (1.5 - y * (3.75 - 13.125 * y)))
        return v_kept * torch.where(at > _FAR, far, near).to(v_kept)


class _TwoRates(NamedTuple):
    """How n bodies of two nodes relax: [n] each.

    Args:
        log_rates: of a₁ and a₂.
        share: of the response at a₁ in the mean of both.
        own: share of e^{-a₁ t} in what is left of the surface's own start.
        of_core: factor of e^{-a₂ t} - e^{-a₁ t} in what is left of the core's.
    """

    log_rates: tuple[Tensor, Tensor]
    share: Tensor
    own: Tensor
    of_core: Tensor


def _two_rates(core: Core, log_rate: Tensor, stiffness: Tensor | float) -> _TwoRates:
    """Of surfaces with log r and s: the eigenvalues in units of r (s + κ), so that no digits are lost at any rates."""
    leaving = stiffness + core.coupling
    coupled, free = core.coupling / leaving, stiffness / leaving  # 1 - coupled would lose s beside a large κ
    log_scale = log_rate + leaving.log()
    slow = torch.exp(core.log_rate - log_scale)
    root = ((1 - slow).square() + 4 * slow * coupled).sqrt()
    fast = 0.5 * (1 + slow + root)
    own = 0.5 * (1 - slow + root) / root
    log_fast = log_scale + fast.log()
    log_slow = log_scale + free.log() + core.log_rate - log_fast  # a₁ a₂ = r s μ
    return _TwoRates((log_fast, log_slow), own * free / fast, own, coupled / root)
