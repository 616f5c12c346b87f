"""Heat balances of surfaces, integrated along a record of weather, with sensitivities.

heatsplat.physics.marching and heatsplat.physics.sunlight say what the symbols mean and drive these kernels. A value
comes with its derivatives by all parameters, which obey linear equations with the same exponentials and cost a few
multiply-adds each. Results do not depend on the number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.compile_time import compile_time, constant
from heatsplat.kernels.scheduling import parallel_for
from heatsplat.kernels.simd import LANES, bits, exp, floor, load_vector, maximum, minimum, select, sqrt, store_vector

BLOCK = 64  # Gaussians per parallel task
SERIES_BELOW = 0.5  # of y: seven terms then leave 1e-9, and the plain quotients would cancel for small y
SUBSTEPS = 8  # of an interval between samples, at most: of bodies that settle within it
STEP = 0.35  # of y that one substep covers, if they suffice
GUSTS = 32  # substeps at most where the exchange with the air changes while bodies settle
BEND = 26.0  # of those, where its fourth root doubles; it then changes by 0.15 of itself in a substep
SETTLING = 4.0  # y of an interval beyond STEP from which on they are needed in full
CALM = 1e-3  # exchange below which its changes do not count
FORGOTTEN = 1e-20  # share of the start that counts as none
COVERS_MM = 0.1  # a film of water thinner than this covers part of a surface
TRACE_MM = 1e-3 * COVERS_MM
PIECE_S = 120.0  # of an interval, over which a film dries evenly
LONGEST_S = 600.0  # for which what water covers is told ahead; longer intervals are passed in pieces where it rains
LATENT_J_KG, AIR_J_M3_K, VAPOUR_J_KG_K = 2.45e6, 1.2e3, 461.5  # Λ of water, ρ c of air, gas constant of vapour
# Magnus' formula, 610.94 Pa exp(17.625 c / (c + 243.04)) at c °C, as L ρ_sat.
ZERO_C, MAGNUS, MAGNUS_C = 273.15, 17.625, 243.04
SATURATED = 610.94 / VAPOUR_J_KG_K * LATENT_J_KG / AIR_J_M3_K

# Rows of the drivers of ``march``; those of effects that are off are not read.
AIR, SKY, AROUND, LIGHT, WIND_ANOMALY, BEAM_X, BEAM_Y, BEAM_Z, GROUND, VAPOUR, RAIN, DRIES = range(12)
START, LOG_RATE = 0, 1  # columns of its parameters that every balance has


@compile_time
@dataclass(frozen=True)
class Balance:
    """Which effects a heat balance has beside the air; ``march`` is compiled for each, without a trace of the others.

    Args:
        radiates: with the share p of exchange that is radiation.
        sunny: with absorptance g.
        windy: with sensitivity v to wind.
        oriented: with normals; without them surfaces lie level.
        shaded: with the share of the beam that reaches them.
        grounded: with light that the ground reflects.
        heated: with heat f from within, constant or from a room.
        cored: with a core behind the surface.
        rained: with water of rain on it until it has evaporated.
        transpiring: with the share q of a wet surface's evaporation that it has where it is dry.
        sensitive: derivatives come with values.
    """

    radiates: bool
    sunny: bool
    windy: bool
    oriented: bool
    shaded: bool
    grounded: bool
    heated: bool
    cored: bool
    rained: bool
    transpiring: bool
    sensitive: bool

    @property
    def changing(self) -> bool:
        """Whether the exchange with the air goes with time."""
        return self.windy or self.moist

    @property
    def moist(self) -> bool:
        """Whether water evaporates."""
        return self.rained or self.transpiring

    @property
    def share_column(self) -> int:
        """Column of p among the parameters; columns of effects that are off do not exist."""
        return 2

    @property
    def sun_column(self) -> int:
        """Column of g."""
        return self.share_column + self.radiates

    @property
    def wind_column(self) -> int:
        """Column of v."""
        return self.sun_column + self.sunny

    @property
    def inner_column(self) -> int:
        """Column of f."""
        return self.wind_column + self.windy

    @property
    def core_column(self) -> int:
        """First of the three columns of the core: y at the start, log μ and log κ."""
        return self.inner_column + self.heated

    @property
    def transpiring_column(self) -> int:
        """Column of q."""
        return self.core_column + 3 * self.cored

    @property
    def film_column(self) -> int:
        """Column of the water on the surface at the first sample."""
        return self.transpiring_column + self.transpiring

    @property
    def normal_column(self) -> int:
        """First of the three columns of the unit normal, behind which comes the share of sky in what a surface sees."""
        return self.film_column + self.rained


radiates, sunny = constant("radiates"), constant("sunny")
windy, oriented, sensitive = constant("windy"), constant("oriented"), constant("sensitive")
shaded, grounded = constant("shaded"), constant("grounded")
heated, cored = constant("heated"), constant("cored")
rained, transpiring = constant("rained"), constant("transpiring")
moist, changing = constant("moist"), constant("changing")
share_column, sun_column = constant("share_column"), constant("sun_column")
wind_column, inner_column = constant("wind_column"), constant("inner_column")
core_column, transpiring_column = constant("core_column"), constant("transpiring_column")
film_column, normal_column = constant("film_column"), constant("normal_column")


@inline
def weights(y):
    """e^-y and φ1, φ2, φ3 of exponential integrators at y >= 0: φ_k = (1/(k-1)! - φ_{k-1}) / y with φ_0 = e^-y."""
    if y < SERIES_BELOW:
        third = 1 / 6 + y * (-1 / 24 + y * (1 / 120 + y * (-1 / 720 + y * (1 / 5040 + y * (-1 / 40320 + y / 362880)))))
        second = 0.5 - y * third
        first = 1.0 - y * second
        return 1.0 - y * first, first, second, third
    decay = math.exp(-y)
    first = (1.0 - decay) / y
    second = (1.0 - first) / y
    return decay, first, second, (0.5 - second) / y


@inline
def _recent_sunlight_block(block, normals, log_rates, steps, beams, seen, slots, last, responses, slopes, vectors):
    """``recent_sunlight`` of BLOCK Gaussians."""
    count, intervals = log_rates.shape[0], steps.shape[0]
    for i in range(block * BLOCK, min((block + 1) * BLOCK, count)):
        nx, ny, nz = float(normals[i, 0]), float(normals[i, 1]), float(normals[i, 2])
        rate = math.exp(float(log_rates[i]))
        y, response, slope, vx, vy, vz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        shaded = seen.shape[1] > 0
        bx, by, bz = beams[0, 0], beams[0, 1], beams[0, 2]
        if shaded:
            share = float(seen[i, slots[0]])
            bx, by, bz = share * bx, share * by, share * bz
        u = nx * bx + ny * by + nz * bz
        if u <= 0.0:
            u, bx, by, bz = 0.0, 0.0, 0.0, 0.0
        seconds, decay, before, after, phi = -1.0, 1.0, 0.0, 0.0, 1.0
        for k in range(intervals):
            cx, cy, cz = beams[k + 1, 0], beams[k + 1, 1], beams[k + 1, 2]
            if shaded:
                share = float(seen[i, slots[k + 1]])
                cx, cy, cz = share * cx, share * cy, share * cz
            v = nx * cx + ny * cy + nz * cz
            if v <= 0.0:
                v, cx, cy, cz = 0.0, 0.0, 0.0, 0.0
            step = steps[k]
            if k == intervals - 1:
                step *= last
                v, cx, cy, cz = (
                    u + last * (v - u),
                    bx + last * (cx - bx),
                    by + last * (cy - by),
                    bz + last * (cz - bz),
                )
            if step != seconds:
                seconds, y = step, rate * step
                decay, phi, second, _ = weights(y)
                after = y * second
                before = phi - decay
            slope = decay * (slope - y * response) + (y * decay - before) * u + before * v
            response = decay * response + before * u + after * v
            vx = decay * vx + before * bx + after * cx
            vy = decay * vy + before * by + after * cy
            vz = decay * vz + before * bz + after * cz
            u, bx, by, bz = v, cx, cy, cz
        responses[i], slopes[i] = response, slope
        vectors[i, 0], vectors[i, 1], vectors[i, 2] = vx, vy, vz


@kernel
def recent_sunlight(normals, log_rates, steps, beams, seen, slots, last, responses, slopes, vectors):
    """Settled responses to max(n · beam, 0), which is linear between samples, from rest at the first sample.

    Args:
        normals: [n, 3].
        log_rates: [n].
        steps: [K] float64 seconds between samples.
        beams: [K + 1, 3] float64 direction times strength at the samples.
        seen: [n, D] share of the beam that reaches them from D directions, or [n, 0]: all of it.
        slots: [K + 1] int64 direction of each sample.
        last: share of the last step that has passed; u goes that far towards its last sample.
        responses: [n] filled with Y.
        slopes: [n] filled with dY / d log a.
        vectors: [n, 3] filled with dY / dn.
    """
    parallel_for(
        _recent_sunlight_block,
        (log_rates.shape[0] + BLOCK - 1) // BLOCK,
        (normals, log_rates, steps, beams, seen, slots, last, responses, slopes, vectors),
    )


@inline
def power(x, inverse):
    """(T⁴ - R⁴) / (4 R³) of T = R + x, and its derivative (T / R)³; of 1 / R."""
    z = x * inverse
    return x * (1.0 + z * (1.5 + z * (1.0 + 0.25 * z))), (1.0 + z) * (1.0 + z) * (1.0 + z)


@inline
def weights_of_lanes(y):
    """``weights`` of lanes; where all are slow, without an exponential."""
    third = 1 / 40320 + y * (-1 / 362880 + y * (1 / 3628800 + y * (-1 / 39916800)))
    third = 1 / 6 + y * (-1 / 24 + y * (1 / 120 + y * (-1 / 720 + y * (1 / 5040 + y * -third))))
    second = 0.5 - y * third
    first = 1.0 - y * second
    decay = 1.0 - y * first
    large = y >= 1.0
    if bits(large) != 0:
        fast = exp(-y)
        a = (1.0 - fast) / y
        b = (1.0 - a) / y
        decay, first, second = select(large, fast, decay), select(large, a, first), select(large, b, second)
        third = select(large, (0.5 - b) / y, third)
    return decay, first, second, third


class Surfaces(NamedTuple):
    """LANES of them: their parameters, and what follows from them; lanes of zeros for effects that are off. Numbers alike for
    all of them are those of the room behind, of the reference, its inverse, and how much water stays on them."""

    rate: Any
    share: Any
    absorptance: Any
    wind: Any
    inner: Any
    leak: Any
    slower: Any
    coupling: Any
    sky: Any
    nx: Any
    ny: Any
    nz: Any
    transpires: Any
    indoors: Any
    reference: Any
    inverse: Any
    holds: Any


class Sensitivities(NamedTuple):
    """Derivatives of surface and core by each parameter."""

    start: Any
    rate: Any
    share: Any
    sun: Any
    wind: Any
    inner: Any
    core: Any
    slower: Any
    coupling: Any
    transpires: Any


class State(NamedTuple):
    """x and y, the digits of them that were lost, the water on the surface in mm, and derivatives."""

    x: Any
    y: Any
    lost: Any
    lost_y: Any
    film: Any
    by: Any


class Drivers(NamedTuple):
    """What drives surfaces at a moment, or what changes of it; ``wet`` is the share of a surface that water covers."""

    air: Any
    wind: Any
    wet: Any
    vapour: Any
    sky: Any
    sun: Any


class Found(NamedTuple):
    """What drives surfaces as they find it that evaporate water.

    Args:
        air: T_eq, which they follow by the tangent of evaporation at their temperature.
        wind, sky, sun: as they are.
        times: as fast as dry ones they follow it.
        moist: share of a wet surface's evaporation that they have.
    """

    air: Any
    wind: Any
    times: Any
    moist: Any
    sky: Any
    sun: Any


class Pace(NamedTuple):
    """Substeps of an interval, even in what goes from ``root`` by ``root_change``; ``whole`` is its integral."""

    substeps: Any
    root: Any
    root_change: Any
    whole: Any


class Side(NamedTuple):
    """The balance at one end of a substep."""

    drivers: Any
    x: Any
    y: Any
    w: Any
    force: Any


@inline
def _powers(a, b):
    """(a⁴ - b⁴) / (a - b), without the difference."""
    return (a + b) * (a * a + b * b)


@inline
def _bent(balance, second, third, c_d, air_d, x_d, p, steep, w_d):
    """What a substep adds for products of exchange and air, of exchange and x, and for T⁴, by changes over the substep."""
    rest, bent = x_d * 0.0, 2.0 * third
    if changing(balance):
        rest = c_d * (air_d * (bent - second) - x_d * (bent - 0.5 * second))
    if radiates(balance):
        rest = rest + bent * p * (steep * x_d - w_d)
    return rest


@inline
def _of_both(fast, slow, own, toward, back):
    """A function of the balance's matrix by its values at both decays: what surface and core get of the surface's, then of the
    core's."""
    apart = slow - fast
    return slow - own * apart, back * apart, toward * apart, fast + own * apart


@inline
def _functions(balance, stiffness, rh, slower, coupling):
    """e^-M, φ1, φ2 and φ3 of a substep, each as four numbers (``_of_both``); of bodies of one node the first alone counts.

    M in units of ``rh`` is [[s + κ, -κ], [-m, m]] with stiffness s and m = μ / r, whose eigenvalues are real and positive.
    """
    nothing = stiffness * 0.0
    if cored(balance):
        leaving = stiffness + coupling
        coupled, following = coupling / leaving, slower / leaving
        root = sqrt((1.0 - following) * (1.0 - following) + 4.0 * following * coupled)
        own = 0.5 * (1.0 - following + root) / root
        fast = 0.5 * (1.0 + following + root)
        quick, late = weights_of_lanes(fast * leaving * rh), weights_of_lanes(stiffness * rh * following / fast)
        toward, back = coupled / root, following / root
        return (
            _of_both(quick[0], late[0], own, toward, back),
            _of_both(quick[1], late[1], own, toward, back),
            _of_both(quick[2], late[2], own, toward, back),
            _of_both(quick[3], late[3], own, toward, back),
        )
    decay, phi, second, third = weights_of_lanes(stiffness * rh)
    return (
        (decay, nothing, nothing, nothing),
        (phi, nothing, nothing, nothing),
        (second, nothing, nothing, nothing),
        (third, nothing, nothing, nothing),
    )


@inline
def _carried(balance, going, now, decay, before, first, after, last):
    """Derivatives of surface and core after a substep that drives them by ``first`` at its beginning and ``last`` at its end."""
    surface, core = decay[0] * now[0] + before[0] * first + after[0] * last, now[1]
    if cored(balance):
        surface = surface + decay[2] * now[1]
        core = select(going, decay[1] * now[0] + decay[3] * now[1] + before[1] * first + after[1] * last, core)
    return select(going, surface, now[0]), core


@inline
def _forgetting(balance, going, now, decay):
    """Derivatives by a start after a substep. Nothing of it is left long before digits run out; what is below them is slow to
    compute with."""
    surface, core = select(now[0] > FORGOTTEN, now[0], 0.0), now[1]
    left = decay[0] * surface
    if cored(balance):
        core = select(core > FORGOTTEN, core, 0.0)
        left, core = left + decay[2] * core, select(going, decay[1] * surface + decay[3] * core, core)
    return select(going, left, now[0]), core


@inline
def _loaded(balance, group, parameters, indoors, reference, holds):
    """LANES surfaces, and their state at the first sample; the last lanes of the last group repeat its last surface."""
    body = np.empty((parameters.shape[1], LANES), parameters.dtype)
    for j in range(LANES):
        i = min(group * LANES + j, parameters.shape[0] - 1)
        for column in range(parameters.shape[1]):
            body[column, j] = parameters[i, column]
    x, log_rate = load_vector(body, START), load_vector(body, LOG_RATE)
    nothing = x * 0.0
    one = nothing + 1.0
    share, absorptance, wind, inner, leak = nothing, nothing, nothing, nothing, nothing
    y, slower, coupling, sky, nx, ny, nz = nothing, nothing, nothing, one, nothing, nothing, nothing
    if radiates(balance):
        share = load_vector(body, share_column(balance))
    if sunny(balance):
        absorptance = load_vector(body, sun_column(balance))
    if windy(balance):
        wind = load_vector(body, wind_column(balance))
    if heated(balance):
        inner = load_vector(body, inner_column(balance))
        leak = maximum(inner * indoors, 0.0)
    if cored(balance):
        column = core_column(balance)
        y, coupling = load_vector(body, column), exp(load_vector(body, column + 2))
        slower = exp(load_vector(body, column + 1) - log_rate)
    transpires, film = nothing, nothing
    if transpiring(balance):
        transpires = load_vector(body, transpiring_column(balance))
    if rained(balance):
        film = load_vector(body, film_column(balance))
    if oriented(balance):
        column = normal_column(balance)
        nx, ny, nz = load_vector(body, column), load_vector(body, column + 1), load_vector(body, column + 2)
        sky = load_vector(body, column + 3)
    surfaces = Surfaces(
        exp(log_rate),
        share,
        absorptance,
        wind,
        inner,
        leak,
        slower,
        coupling,
        sky,
        nx,
        ny,
        nz,
        transpires,
        indoors,
        reference,
        1.0 / reference,
        holds,
    )
    still = nothing, nothing
    by = Sensitivities((one, nothing), still, still, still, still, still, (nothing, one), still, still, still)
    return surfaces, State(x, y, nothing, nothing, film, by)


@inline
def _reached(balance, group, seen, like):
    """Shares of the beam that reach the lanes of a group, a row for each direction."""
    lit = np.empty((seen.shape[1], LANES), like.dtype)
    if shaded(balance):
        for j in range(LANES):
            i = min(group * LANES + j, seen.shape[0] - 1)
            for slot in range(seen.shape[1]):
                lit[slot, j] = seen[i, slot]
    return lit


@inline
def _at_sample(balance, surfaces, drivers, lit, slots, k):
    """Drivers at a sample."""
    f = surfaces.sky
    wind, vapour, sky, sun = 0.0, 0.0, f, f
    if windy(balance):
        wind = drivers[WIND_ANOMALY, k]
    if moist(balance):
        vapour = drivers[VAPOUR, k]
    if radiates(balance):
        sky = drivers[AROUND, k] + f * (drivers[SKY, k] - drivers[AROUND, k])
    if sunny(balance):
        sun = f * drivers[LIGHT, k]
        if grounded(balance):
            sun = sun + (1.0 - f) * drivers[GROUND, k]
        if oriented(balance):
            x, y, z = drivers[BEAM_X, k], drivers[BEAM_Y, k], drivers[BEAM_Z, k]
            beam = maximum(surfaces.nx * x + surfaces.ny * y + surfaces.nz * z, 0.0)
            if shaded(balance):
                beam = beam * load_vector(lit, slots[k])
            sun = sun + beam
    return Drivers(drivers[AIR, k], wind, f * 0.0, vapour, sky, sun)


@inline
def _wet(drivers, film):
    """Drivers of surfaces with that much water on them."""
    wet = minimum(film * (1.0 / COVERS_MM), 1.0)
    return Drivers(drivers.air, drivers.wind, wet, drivers.vapour, drivers.sky, drivers.sun)


@inline
def _film(surfaces, film, lacks, lacks_2, drivers, k, share, share_2, seconds):
    """The water in mm after those seconds, from one share of the interval from sample k to another, in which what vapour lacks
    to saturation on the surface goes from ``lacks`` to ``lacks_2``.

    What falls on a full film runs off.
    """
    pieces = max(1, math.ceil(seconds / PIECE_S))
    step = seconds / pieces
    for piece in range(pieces):
        part = (piece + 0.5) / pieces
        ahead = share + part * (share_2 - share)
        dries = (drivers[DRIES, k] + ahead * (drivers[DRIES, k + 1] - drivers[DRIES, k])) * step
        leaves = maximum(lacks + part * (lacks_2 - lacks), 0.0) * dries
        fallen = film + (drivers[RAIN, k] + ahead * (drivers[RAIN, k + 1] - drivers[RAIN, k])) * step
        # Water that covers all dries evenly, and less of it in proportion to what there is: by e^-z, near enough.
        over = maximum(fallen - COVERS_MM, 0.0)
        z = maximum(leaves - over, 0.0) * (1.0 / COVERS_MM)
        left = (fallen - over) / (1.0 + z * (1.0 + z * (0.5 + z * (1 / 6)))) + maximum(over - leaves, 0.0)
        film = minimum(left, surfaces.holds)
    # A trace is dry once the rain is over; while it rains, what has fallen since the last sample may be no more than that.
    if drivers[RAIN, k + 1] == 0.0:
        film = select(film > TRACE_MM, film, 0.0)
    return film


@inline
def _changes(begin, end, share):
    """What drivers change in that share of an interval, in which they are linear."""
    return Drivers(
        share * (end.air - begin.air),
        share * (end.wind - begin.wind),
        share * (end.wet - begin.wet),
        share * (end.vapour - begin.vapour),
        share * (end.sky - begin.sky),
        share * (end.sun - begin.sun),
    )


@inline
def _after(begin, changes, passed):
    """Drivers when that share of their changes has passed."""
    return Drivers(
        begin.air + passed * changes.air,
        begin.wind + passed * changes.wind,
        begin.wet + passed * changes.wet,
        begin.vapour + passed * changes.vapour,
        begin.sky + passed * changes.sky,
        begin.sun + passed * changes.sun,
    )


@inline
def saturated(surfaces, x):
    """L ρ_sat of R + x in kelvin (Magnus' formula: Alduchov and Eskridge 1996, Eq. 21), and its derivative.

    Colder than -100 °C, where nothing of it is left, and hotter than 150 °C it stays what it is there.
    """
    kelvin = minimum(maximum(surfaces.reference + x, ZERO_C - 100.0), ZERO_C + 150.0)
    inverse = 1.0 / (kelvin - (ZERO_C - MAGNUS_C))
    vapour = SATURATED * exp(MAGNUS * (1.0 - MAGNUS_C * inverse)) / kelvin
    return vapour, vapour * (MAGNUS * MAGNUS_C * inverse * inverse - 1.0 / kelvin)


@inline
def _vapour(balance, surfaces, x, water):
    """``saturated``, where it matters: on surfaces that transpire, and while there is ``water`` on any of them; else zeros."""
    vapour, steam = x * 0.0, x * 0.0
    if transpiring(balance) or (rained(balance) and bits(water > 0.0) != 0):
        vapour, steam = saturated(surfaces, x)
    return vapour, steam


@inline
def _found(balance, surfaces, drivers, x, vapour, steep):
    """Drivers as surfaces find them at x, of saturated vapour there and its derivative."""
    air, times, share = drivers.air, 1.0, 0.0
    if moist(balance):
        share = drivers.wet
        lacks = vapour - drivers.vapour
        if transpiring(balance):
            share = share + select(lacks > 0.0, (1.0 - share) * surfaces.transpires, 0.0)
        times = 1.0 + share * steep
        air = drivers.air - share * (lacks + steep * (drivers.air - x)) / times
    return Found(air, drivers.wind, times, share, drivers.sky, drivers.sun)


@inline
def _hastened(balance, surfaces, wind, times, exchange):
    """An exchange with the air, by wind and water."""
    if windy(balance):
        exchange = exchange * (1.0 + surfaces.wind * wind)
    if moist(balance):
        exchange = exchange * times
    return exchange


@inline
def _exchange(balance, surfaces, wind, times):
    """c, with the air."""
    exchange = _hastened(balance, surfaces, wind, times, surfaces.share * 0.0 + 1.0)
    if radiates(balance):
        exchange = (1.0 - surfaces.share) * exchange
    return exchange


@inline
def _stiffness(balance, surfaces, exchange, steep):
    """By how much dx/dt / r falls with x, of bodies of one node, at an exchange with the air."""
    if radiates(balance):
        exchange = exchange + surfaces.share * steep
    if heated(balance):
        exchange = exchange + surfaces.leak
    return exchange


@inline
def _pace(balance, surfaces, begin, end, steep, seconds):
    """How an interval is divided: enough for the fastest that surfaces are in it."""
    times = begin.times
    if moist(balance):
        times = maximum(times, end.times)
    fastest = _exchange(balance, surfaces, max(begin.wind, end.wind), times)
    settled = surfaces.rate * _stiffness(balance, surfaces, fastest, steep) * seconds
    settles = settled > STEP
    substeps = minimum(1.0 + floor(settled * (1.0 / STEP)), SUBSTEPS)
    nothing = settled * 0.0
    one = nothing + 1.0
    root, root_change, whole = one, nothing, one * 4.0
    if changing(balance) and bits(settles) != 0:
        # Of a body that follows at once, a substep errs by the square of what exchange changes in it: substeps are even
        # in its fourth root, near enough to its logarithm.
        early = _stiffness(balance, surfaces, _exchange(balance, surfaces, begin.wind, begin.times), steep)
        late = _stiffness(balance, surfaces, _exchange(balance, surfaces, end.wind, end.times), steep)
        root = select(settles, sqrt(sqrt(maximum(early, CALM))), one)
        root_change = select(settles, sqrt(sqrt(maximum(late, CALM))) - root, nothing)
        whole = _powers(root + root_change, root)
        folds = maximum(root_change, -root_change) / minimum(root, root + root_change)
        settling = minimum(maximum(settled - STEP, 0.0) * (1.0 / SETTLING), 1.0)
        substeps = maximum(substeps, minimum(1.0 + floor(BEND * folds * settling), GUSTS))
    return Pace(substeps, root, root_change, whole)


@inline
def _passed(balance, pace, substep):
    """Share of the interval at the end of a substep."""
    passed = 1.0 / pace.substeps * (substep + 1)
    if changing(balance):
        passed = passed * _powers(pace.root + passed * pace.root_change, pace.root) / pace.whole
    return passed


@inline
def _side(balance, surfaces, drivers, x, y, w):
    """The balance of surfaces at x, of cores at y, with w of x."""
    force = _exchange(balance, surfaces, drivers.wind, drivers.times) * (drivers.air - x)
    if sunny(balance):
        force = force + surfaces.absorptance * drivers.sun
    if radiates(balance):
        force = force + surfaces.share * (drivers.sky - w)
    if heated(balance):
        force = force + surfaces.inner - surfaces.leak * x
    if cored(balance):
        force = force - surfaces.coupling * (x - y)
    return Side(drivers, x, y, w, force)


@inline
def _by_share(balance, surfaces, side):
    """Derivative of the balance by p."""
    drivers = side.drivers
    return drivers.sky - side.w - _hastened(balance, surfaces, drivers.wind, drivers.times, drivers.air - side.x)


@inline
def _by_wind(balance, surfaces, side):
    """Derivative of the balance by v."""
    drivers = side.drivers
    gust = drivers.wind * (drivers.air - side.x)
    if radiates(balance):
        gust = (1.0 - surfaces.share) * gust
    if moist(balance):
        gust = gust * drivers.times
    return gust


@inline
def _by_transpiring(balance, surfaces, drivers, vapour):
    """Derivative of the balance by q, of saturated vapour on the surface."""
    exchange = _exchange(balance, surfaces, drivers.wind, 1.0)
    return (drivers.wet - 1.0) * exchange * maximum(vapour - drivers.vapour, 0.0)


@inline
def _by_inner(surfaces, side):
    """Derivative of the balance by f, which lets heat out where it has the sign of i."""
    one = side.x * 0.0 + 1.0
    return select(surfaces.inner * surfaces.indoors >= 0.0, one - surfaces.indoors * side.x, one)


@inline
def _sensitivities(balance, surfaces, going, by, functions, rh, early, late, drying, drying_2):
    """Derivatives after a substep: of the linearised balance, along the trajectory from its beginning to its end.

    Decays at the slope of its beginning, which takes 0.2 % from what derivatives are, and no second exponential.
    """
    decay, phi, second, _ = functions
    nothing = rh * 0.0
    before, after = (rh * (phi[0] - second[0]), nothing), (rh * second[0], nothing)
    share, sun, wind, inner, core, slower, coupling, transpires = (
        by.share, by.sun, by.wind, by.inner, by.core, by.slower, by.coupling, by.transpires,
    )  # fmt: skip
    if cored(balance):
        before, after = (before[0], rh * (phi[1] - second[1])), (after[0], rh * second[1])
        # What drives cores, by the other half of the matrix.
        before_core = rh * (phi[2] - second[2]), rh * (phi[3] - second[3])
        after_core = rh * second[2], rh * second[3]
        apart, apart_2 = early.x - early.y, late.x - late.y
        core = _forgetting(balance, going, core, decay)
        slower = _carried(
            balance, going, slower, decay, before_core, surfaces.slower * apart, after_core, surfaces.slower * apart_2
        )
        coupling = _carried(
            balance, going, coupling, decay, before, -surfaces.coupling * apart, after, -surfaces.coupling * apart_2
        )
    start = _forgetting(balance, going, by.start, decay)
    rate = _carried(balance, going, by.rate, decay, before, early.force, after, late.force)
    if radiates(balance):
        first, last = _by_share(balance, surfaces, early), _by_share(balance, surfaces, late)
        share = _carried(balance, going, share, decay, before, first, after, last)
    if sunny(balance):
        sun = _carried(balance, going, sun, decay, before, early.drivers.sun, after, late.drivers.sun)
    if windy(balance):
        first, last = _by_wind(balance, surfaces, early), _by_wind(balance, surfaces, late)
        wind = _carried(balance, going, wind, decay, before, first, after, last)
    if heated(balance):
        inner = _carried(
            balance, going, inner, decay, before, _by_inner(surfaces, early), after, _by_inner(surfaces, late)
        )
    if transpiring(balance):
        transpires = _carried(balance, going, transpires, decay, before, drying, after, drying_2)
    return Sensitivities(start, rate, share, sun, wind, inner, core, slower, coupling, transpires)


@inline
def _substep(balance, surfaces, state, going, rh, begin, end):
    """The state after a substep between two sets of drivers, of the lanes that are still ``going``."""
    x, y, p = state.x, state.y, surfaces.share
    w, steep = power(x, surfaces.inverse)
    vapour, steam = _vapour(balance, surfaces, x, begin.wet + end.wet)
    first, last = (
        _found(balance, surfaces, begin, x, vapour, steam),
        _found(balance, surfaces, end, x, vapour, steam),
    )
    early = _side(balance, surfaces, first, x, y, w)
    force, ahead = early.force, _side(balance, surfaces, last, x, y, w).force
    # Linear part: the slope of w here, and the exchange with the air halfway.
    c, c_2 = _exchange(balance, surfaces, first.wind, first.times), _exchange(balance, surfaces, last.wind, last.times)
    slope = _stiffness(balance, surfaces, 0.5 * (c + c_2), steep)
    functions = _functions(balance, slope, rh, surfaces.slower, surfaces.coupling)
    _, phi, second, third = functions
    added, added_y = rh * (phi[0] * force + second[0] * (ahead - force)), rh * 0.0
    if cored(balance):
        follows = surfaces.slower * (x - y)
        added = added + rh * phi[2] * follows
        added_y = rh * (phi[1] * force + second[1] * (ahead - force) + phi[3] * follows)
    if changing(balance) or radiates(balance):
        # What is not linear in time or in x: the products of exchange and air, and of exchange and x, and T⁴.
        w_d, air_d = power(x + added, surfaces.inverse)[0] - w, last.air - first.air
        bent = _bent(balance, second[0], third[0], c_2 - c, air_d, added, p, steep, w_d)
        if cored(balance):
            added_y = added_y + rh * _bent(balance, second[1], third[1], c_2 - c, air_d, added, p, steep, w_d)
        if moist(balance):  # and what evaporates above the tangent
            more = steam * added - (_vapour(balance, surfaces, x + added, begin.wet + end.wet)[0] - vapour)
            more = more * (c * first.moist / first.times + c_2 * last.moist / last.times)
            bent = bent + third[0] * more
            if cored(balance):
                added_y = added_y + rh * third[1] * more
        added = added + rh * bent
    # What digits of x do not hold is added with the next substep (Kahan 1965): between samples a second apart a wall
    # changes by less than they show.
    added, added_y = added + state.lost, added_y + state.lost_y
    new, new_y = x + added, y + added_y
    lost, lost_y = select(going, added - (new - x), state.lost), state.lost_y
    if cored(balance):
        lost_y = select(going, added_y - (new_y - y), lost_y)
    by = state.by
    if sensitive(balance):
        vapour_2, drying, drying_2 = vapour, vapour, vapour
        if moist(balance):
            vapour_2, steam_2 = _vapour(balance, surfaces, new, begin.wet + end.wet)
            last = _found(balance, surfaces, end, new, vapour_2, steam_2)
        if transpiring(balance):
            drying = _by_transpiring(balance, surfaces, begin, vapour)
            drying_2 = _by_transpiring(balance, surfaces, end, vapour_2)
        late = _side(balance, surfaces, last, new, new_y, power(new, surfaces.inverse)[0])
        by = _sensitivities(balance, surfaces, going, by, functions, rh, early, late, drying, drying_2)
    return State(select(going, new, x), select(going, new_y, y), lost, lost_y, state.film, by)


@inline
def _over_piece(balance, surfaces, state, begin, changes, drivers, k, share, share_2, seconds):
    """The state after those seconds, from one share of the interval from sample k to another, in which drivers change linearly.

    What water covers is told ahead by how warm surfaces are at the beginning, and at the end by how warm they were.
    """
    film, water = state.film, state.film
    if rained(balance):
        water = film + (drivers[RAIN, k] + drivers[RAIN, k + 1])
    vapour, steam = _vapour(balance, surfaces, state.x, water)
    lacks, wet = vapour - begin.vapour, bits(water > 0.0) != 0
    if rained(balance) and wet:
        ahead = _film(surfaces, film, lacks, lacks - changes.vapour, drivers, k, share, share_2, seconds)
        begin = _wet(begin, film)
        changes = _changes(begin, _wet(_after(begin, changes, 1.0), ahead), 1.0)
    then = _after(begin, changes, 1.0)
    pace = _pace(
        balance,
        surfaces,
        _found(balance, surfaces, begin, state.x, vapour, steam),
        _found(balance, surfaces, then, state.x, vapour, steam),
        power(state.x, surfaces.inverse)[1],
        seconds,
    )
    passed, rh = surfaces.rate * 0.0, surfaces.rate * (1.0 / pace.substeps) * seconds
    for substep in range(GUSTS):
        going = pace.substeps > substep
        if bits(going) == 0:
            break
        later = _passed(balance, pace, substep)
        if changing(balance):
            rh = surfaces.rate * (later - passed) * seconds
        before, after = _after(begin, changes, passed), _after(begin, changes, later)
        state = _substep(balance, surfaces, state, going, rh, before, after)
        passed = later
    if rained(balance) and wet:
        lacks_2 = saturated(surfaces, state.x)[0] - then.vapour
        film = _film(surfaces, film, lacks, lacks_2, drivers, k, share, share_2, seconds)
    return State(state.x, state.y, state.lost, state.lost_y, film, state.by)


@inline
def _over_interval(balance, surfaces, state, begin, end, drivers, k, share, seconds):
    """The state after those seconds, that share of the interval from sample k, in which drivers change linearly.

    Pieces are of the record alone: of how wet other lanes are, nothing that is found may depend.
    """
    changes = _changes(begin, end, share)
    if rained(balance):
        pieces = max(1, math.ceil(seconds / LONGEST_S - 1e-9))
        for piece in range(pieces):
            early, late = piece / pieces * share, (piece + 1) / pieces * share
            now, then = _after(begin, changes, piece / pieces), _changes(begin, end, late - early)
            state = _over_piece(balance, surfaces, state, now, then, drivers, k, early, late, seconds / pieces)
    else:
        state = _over_piece(balance, surfaces, state, begin, changes, drivers, k, 0.0, share, seconds)
    return state


@inline
def _store(balance, told, state):
    """Fills ``told`` [columns of found, LANES]."""
    store_vector(told, 0, state.x)
    if sensitive(balance):
        store_vector(told, 1 + START, state.by.start[0])
        store_vector(told, 1 + LOG_RATE, state.by.rate[0])
        if radiates(balance):
            store_vector(told, 1 + share_column(balance), state.by.share[0])
        if sunny(balance):
            store_vector(told, 1 + sun_column(balance), state.by.sun[0])
        if windy(balance):
            store_vector(told, 1 + wind_column(balance), state.by.wind[0])
        if heated(balance):
            store_vector(told, 1 + inner_column(balance), state.by.inner[0])
        if cored(balance):
            column = 1 + core_column(balance)
            store_vector(told, column, state.by.core[0])
            store_vector(told, column + 1, state.by.slower[0])
            store_vector(told, column + 2, state.by.coupling[0])
        if transpiring(balance):
            store_vector(told, 1 + transpiring_column(balance), state.by.transpires[0])
    else:
        if cored(balance):
            store_vector(told, 1, state.y)
        if rained(balance):
            store_vector(told, 1 + cored(balance), state.film)


@inline
def _march_group(
    group, balance, first, parameters, seen, slots, rows, times, drivers, reference, indoors, holds, moments, found
):
    """``march`` of LANES Gaussians."""
    surfaces, state = _loaded(balance, group, parameters, indoors, reference, holds)
    lit = _reached(balance, group, seen, parameters)
    told = np.empty((found.shape[2], LANES), parameters.dtype)
    k, moment = first, 0
    while moment < moments.shape[0]:
        # To the end of the interval; to a moment within it on the way, after which the state is that of before.
        interval = times[k + 1] - times[k]
        aside = moments[moment] <= times[k + 1]
        ending = 1.0
        if aside:
            ending = (moments[moment] - times[k]) / interval
        begin = _at_sample(balance, surfaces, drivers, lit, slots, k)
        end = _at_sample(balance, surfaces, drivers, lit, slots, k + 1)
        then = _over_interval(balance, surfaces, state, begin, end, drivers, k, ending, interval * ending)
        if aside:
            _store(balance, told, then)
            for j in range(min(LANES, rows.shape[0] - group * LANES)):
                for column in range(found.shape[2]):
                    found[moment, rows[group * LANES + j], column] = told[column, j]
            moment += 1
        if ending == 1.0:
            k, state = k + 1, then


@kernel
def march(balance, first, parameters, seen, slots, rows, times, drivers, reference, indoors, holds, moments, found):
    """Temperatures at moments under the full balance: T⁴ as it is, wind as it blows.

    dx/dt = r [g G(t) + c(t) (air - x - E) + p (s(t) - w(x)) + f - max(f i, 0) x + κ (y - x)] and dy/dt = μ (x - y), with w from
    ``power``, c = (1 - p) (1 + v wind_anomaly), G = a light + (1 - a) ground + V max(n · beam, 0) and s = a sky +
    (1 - a) around. Evaporation is E = m (``saturated``(x) - vapour), with m = u where a share u is wet, and u + (1 - u) q where
    surfaces transpire; it dries what rain has left (``_film``). Derivatives take u for given.
    Exponential Rosenbrock steps of third order (Hochbruck, Ostermann and Schweitzer 2009, exprb32), each interval in equal
    substeps, as many as the surface is fast. Lanes are Gaussians; what is found of one depends neither on the others nor on
    the other moments.

    Args:
        balance: the effects that there are; without an effect its terms are left out, and with a = 1 where surfaces lie
            level.
        first: sample from which they start.
        parameters: [n, P] x at that sample in kelvin above the reference, log r, then those of ``balance``, of which water on
            the surface in mm and the normal are given; float32 or float64, in which all is computed. Neighbours of like rates
            are quickest.
        seen: [n, D] V, share of the beam that reaches them from D directions; [n, 0] where all of it does.
        slots: [T] int64 direction of the beam at each sample.
        rows: [n] int64 rows of ``found`` that they fill.
        times: [T] float64 samples.
        drivers: [12, T] float64; vapour in kelvin, rain in mm/s, and what dries a wet surface in mm/(s K).
        reference: R in kelvin.
        indoors: i in 1/K, of 1 over the temperature of the room behind, above the reference; 0 where f is constant.
        holds: mm of water that stay on surfaces.
        moments: [F] float64, increasing, within the samples from ``first`` on.
        found: [F, N, ...] filled with x, behind it y and then mm of water where there are such; or, of a balance that is
            sensitive, [F, N, 1 + Q] with x and its derivatives by the parameters that are not given.
    """
    parallel_for(
        _march_group,
        (rows.shape[0] + LANES - 1) // LANES,
        (balance, first, parameters, seen, slots, rows, times, drivers, reference, indoors, holds, moments, found),
    )
