"""Heat balances of surfaces, marched along a record of weather, with sensitivities.

heatsplat.physics.marching drives this kernel, and heatsplat.kernels.heat_balance has the balance at a moment. A value comes with
its derivatives by all parameters, which obey linear equations with the same exponentials and cost a few multiply-adds each.
Results do not depend on the number of threads.

From the inside out: ``_substep`` carries a state on by functions of the balance's matrix; ``_over_piece`` takes as many
substeps as surfaces are fast (``_pace``); ``_over_interval`` goes from one sample of the record to the next, in pieces where it
rains; ``march`` passes the intervals and stores what it meets at moments.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.heat_balance import (
    COVERS_MM,
    DRIES,
    RAIN,
    Surfaces,
    by_inner,
    by_share,
    by_transpiring,
    by_wind,
    changes_of,
    changing,
    core_column,
    cored,
    drivers_after,
    drivers_at,
    exchange_of,
    film_column,
    found_at,
    heated,
    inner_column,
    moist,
    normal_column,
    oriented,
    power,
    radiates,
    rained,
    saturated,
    sensitive,
    shaded,
    share_column,
    side_of,
    stiffness_of,
    sun_column,
    sunny,
    transpiring,
    transpiring_column,
    vapour_on,
    wetted,
    wind_column,
    windy,
)
from heatsplat.kernels.scheduling import parallel_for
from heatsplat.kernels.simd import LANES, bits, exp, floor, load_vector, maximum, minimum, select, sqrt, store_vector

SUBSTEPS = 8  # of an interval between samples, at most: of bodies that settle within it
STEP = 0.35  # of y that one substep covers, if they suffice
GUSTS = 32  # substeps at most where the exchange with the air changes while bodies settle
BEND = 26.0  # of those, where its fourth root doubles; it then changes by 0.15 of itself in a substep
SETTLING = 4.0  # y of an interval beyond STEP from which on they are needed in full
CALM = 1e-3  # exchange below which its changes do not count
FORGOTTEN = 1e-20  # share of the start that counts as none
TRACE_MM = 1e-3 * COVERS_MM
PIECE_S = 120.0  # of an interval, over which a film dries evenly
LONGEST_S = 600.0  # for which what water covers is told ahead; longer intervals are passed in pieces where it rains

START, LOG_RATE = 0, 1  # columns of the parameters that every balance has


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


# One substep ----------------------------------------------------------------------------------------------------------


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
def _bent(balance, second, third, c_d, air_d, x_d, p, steep, w_d):
    """What a substep adds for products of exchange and air, of exchange and x, and for T⁴, by changes over the substep."""
    rest, bent = x_d * 0.0, 2.0 * third
    if changing(balance):
        rest = c_d * (air_d * (bent - second) - x_d * (bent - 0.5 * second))
    if radiates(balance):
        rest = rest + bent * p * (steep * x_d - w_d)
    return rest


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
        first, last = by_share(balance, surfaces, early), by_share(balance, surfaces, late)
        share = _carried(balance, going, share, decay, before, first, after, last)
    if sunny(balance):
        sun = _carried(balance, going, sun, decay, before, early.drivers.sun, after, late.drivers.sun)
    if windy(balance):
        first, last = by_wind(balance, surfaces, early), by_wind(balance, surfaces, late)
        wind = _carried(balance, going, wind, decay, before, first, after, last)
    if heated(balance):
        inner = _carried(
            balance, going, inner, decay, before, by_inner(surfaces, early), after, by_inner(surfaces, late)
        )
    if transpiring(balance):
        transpires = _carried(balance, going, transpires, decay, before, drying, after, drying_2)
    return Sensitivities(start, rate, share, sun, wind, inner, core, slower, coupling, transpires)


@inline
def _substep(balance, surfaces, state, going, rh, begin, end):
    """The state after a substep between two sets of drivers, of the lanes that are still ``going``."""
    x, y, p = state.x, state.y, surfaces.share
    w, steep = power(x, surfaces.inverse)
    vapour, steam = vapour_on(balance, surfaces, x, begin.wet + end.wet)
    first, last = (
        found_at(balance, surfaces, begin, x, vapour, steam),
        found_at(balance, surfaces, end, x, vapour, steam),
    )
    early = side_of(balance, surfaces, first, x, y, w)
    force, ahead = early.force, side_of(balance, surfaces, last, x, y, w).force
    # Linear part: the slope of w here, and the exchange with the air halfway.
    c, c_2 = (
        exchange_of(balance, surfaces, first.wind, first.times),
        exchange_of(balance, surfaces, last.wind, last.times),
    )
    slope = stiffness_of(balance, surfaces, 0.5 * (c + c_2), steep)
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
            more = steam * added - (vapour_on(balance, surfaces, x + added, begin.wet + end.wet)[0] - vapour)
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
            vapour_2, steam_2 = vapour_on(balance, surfaces, new, begin.wet + end.wet)
            last = found_at(balance, surfaces, end, new, vapour_2, steam_2)
        if transpiring(balance):
            drying = by_transpiring(balance, surfaces, begin, vapour)
            drying_2 = by_transpiring(balance, surfaces, end, vapour_2)
        late = side_of(balance, surfaces, last, new, new_y, power(new, surfaces.inverse)[0])
        by = _sensitivities(balance, surfaces, going, by, functions, rh, early, late, drying, drying_2)
    return State(select(going, new, x), select(going, new_y, y), lost, lost_y, state.film, by)


# From one sample to the next ------------------------------------------------------------------------------------------


class Pace(NamedTuple):
    """Substeps of an interval, even in what goes from ``root`` by ``root_change``; ``whole`` is its integral."""

    substeps: Any
    root: Any
    root_change: Any
    whole: Any


@inline
def _powers(a, b):
    """(a⁴ - b⁴) / (a - b), without the difference."""
    return (a + b) * (a * a + b * b)


@inline
def _pace(balance, surfaces, begin, end, steep, seconds):
    """How an interval is divided: enough for the fastest that surfaces are in it."""
    times = begin.times
    if moist(balance):
        times = maximum(times, end.times)
    fastest = exchange_of(balance, surfaces, max(begin.wind, end.wind), times)
    settled = surfaces.rate * stiffness_of(balance, surfaces, fastest, steep) * seconds
    settles = settled > STEP
    substeps = minimum(1.0 + floor(settled * (1.0 / STEP)), SUBSTEPS)
    nothing = settled * 0.0
    one = nothing + 1.0
    root, root_change, whole = one, nothing, one * 4.0
    if changing(balance) and bits(settles) != 0:
        # Of a body that follows at once, a substep errs by the square of what exchange changes in it: substeps are even
        # in its fourth root, near enough to its logarithm.
        early = stiffness_of(balance, surfaces, exchange_of(balance, surfaces, begin.wind, begin.times), steep)
        late = stiffness_of(balance, surfaces, exchange_of(balance, surfaces, end.wind, end.times), steep)
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
def _over_piece(balance, surfaces, state, begin, changes, drivers, k, share, share_2, seconds):
    """The state after those seconds, from one share of the interval from sample k to another, in which drivers change linearly.

    What water covers is told ahead by how warm surfaces are at the beginning, and at the end by how warm they were.
    """
    film, water = state.film, state.film
    if rained(balance):
        water = film + (drivers[RAIN, k] + drivers[RAIN, k + 1])
    vapour, steam = vapour_on(balance, surfaces, state.x, water)
    lacks, wet = vapour - begin.vapour, bits(water > 0.0) != 0
    if rained(balance) and wet:
        ahead = _film(surfaces, film, lacks, lacks - changes.vapour, drivers, k, share, share_2, seconds)
        begin = wetted(begin, film)
        changes = changes_of(begin, wetted(drivers_after(begin, changes, 1.0), ahead), 1.0)
    then = drivers_after(begin, changes, 1.0)
    pace = _pace(
        balance,
        surfaces,
        found_at(balance, surfaces, begin, state.x, vapour, steam),
        found_at(balance, surfaces, then, state.x, vapour, steam),
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
        before, after = drivers_after(begin, changes, passed), drivers_after(begin, changes, later)
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
    changes = changes_of(begin, end, share)
    if rained(balance):
        pieces = max(1, math.ceil(seconds / LONGEST_S - 1e-9))
        for piece in range(pieces):
            early, late = piece / pieces * share, (piece + 1) / pieces * share
            now, then = drivers_after(begin, changes, piece / pieces), changes_of(begin, end, late - early)
            state = _over_piece(balance, surfaces, state, now, then, drivers, k, early, late, seconds / pieces)
    else:
        state = _over_piece(balance, surfaces, state, begin, changes, drivers, k, 0.0, share, seconds)
    return state


# Along the record -----------------------------------------------------------------------------------------------------


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
        begin = drivers_at(balance, surfaces, drivers, lit, slots, k)
        end = drivers_at(balance, surfaces, drivers, lit, slots, k + 1)
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
