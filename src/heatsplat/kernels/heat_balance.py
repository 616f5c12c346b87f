"""Heat balances of surfaces, integrated along a record of weather, with sensitivities.

heatsplat.physics.marching and heatsplat.physics.sunlight say what the symbols mean and drive these kernels. A value
comes with its derivatives by all parameters, which obey linear equations with the same exponentials and cost a few
multiply-adds each. Results do not depend on the number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

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

# Rows of the drivers of ``march``; those of effects that are off are not read.
AIR, SKY, AROUND, LIGHT, WIND_ANOMALY, BEAM_X, BEAM_Y, BEAM_Z, GROUND, WETTED = range(10)
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
        wetted: with water on it, which hastens its exchange with the air.
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
    wetted: bool
    sensitive: bool

    @property
    def changing(self) -> bool:
        """Whether the exchange with the air goes with time."""
        return self.windy or self.wetted

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
    def normal_column(self) -> int:
        """First of the three columns of the unit normal, behind which comes the share of sky in what a surface sees."""
        return self.core_column + 3 * self.cored


radiates, sunny = constant("radiates"), constant("sunny")
windy, oriented, sensitive = constant("windy"), constant("oriented"), constant("sensitive")
shaded, grounded = constant("shaded"), constant("grounded")
heated, cored = constant("heated"), constant("cored")
wetted, changing = constant("wetted"), constant("changing")
share_column, sun_column = constant("share_column"), constant("sun_column")
wind_column, inner_column = constant("wind_column"), constant("inner_column")
core_column, normal_column = constant("core_column"), constant("normal_column")


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
def _march_group(
    group, balance, first, parameters, seen, slots, rows, times, drivers, reference, indoors, moments, found
):
    """``march`` of LANES Gaussians."""
    count = rows.shape[0]
    body = np.empty((parameters.shape[1], LANES), parameters.dtype)
    for j in range(LANES):
        i = min(group * LANES + j, count - 1)
        for column in range(parameters.shape[1]):
            body[column, j] = parameters[i, column]
    lit = np.empty((seen.shape[1], LANES), parameters.dtype)
    if shaded(balance):
        for j in range(LANES):
            i = min(group * LANES + j, count - 1)
            for slot in range(seen.shape[1]):
                lit[slot, j] = seen[i, slot]
    told = np.empty((found.shape[2], LANES), parameters.dtype)
    x = load_vector(body, START)
    nothing = x * 0.0
    one = nothing + 1.0
    r = exp(load_vector(body, LOG_RATE))
    p, g, v, f, nx, ny, nz = nothing, nothing, nothing, one, nothing, nothing, nothing
    y, inner, leak, slower, coupling = nothing, nothing, nothing, nothing, nothing
    if radiates(balance):
        p = load_vector(body, share_column(balance))
    if sunny(balance):
        g = load_vector(body, sun_column(balance))
    if windy(balance):
        v = load_vector(body, wind_column(balance))
    if heated(balance):
        inner = load_vector(body, inner_column(balance))
        leak = maximum(inner * indoors, 0.0)
    if cored(balance):
        column = core_column(balance)
        y, coupling = load_vector(body, column), exp(load_vector(body, column + 2))
        slower = exp(load_vector(body, column + 1) - load_vector(body, LOG_RATE))
    if oriented(balance):
        column = normal_column(balance)
        f = load_vector(body, column + 3)
        nx, ny, nz = load_vector(body, column), load_vector(body, column + 1), load_vector(body, column + 2)
    lost, lost_y = nothing, nothing
    still = nothing, nothing
    d_start, d_rate, d_share, d_sun, d_wind = (one, nothing), still, still, still, still
    d_inner, d_core, d_slower, d_coupling = still, (nothing, one), still, still
    k, moment, inverse = first, 0, 1.0 / reference
    while moment < moments.shape[0]:
        # To the end of the interval; to a moment within it on the way, after which the state is that of before.
        interval = times[k + 1] - times[k]
        aside = moments[moment] <= times[k + 1]
        ending = 1.0
        if aside:
            ending = (moments[moment] - times[k]) / interval
        seconds = interval * ending
        kept = x, y, lost, lost_y, d_start, d_rate, d_share, d_sun, d_wind, d_inner, d_core, d_slower, d_coupling
        # Drivers at its beginning, and what they change until its end.
        air_1, air_d = drivers[AIR, k], ending * (drivers[AIR, k + 1] - drivers[AIR, k])
        wind_1, wind_d, sky_1, sky_d, sun_1, sun_d = 0.0, 0.0, nothing, nothing, nothing, nothing
        fastest = one
        if windy(balance):
            wind_1, wind_d = (
                drivers[WIND_ANOMALY, k],
                ending * (drivers[WIND_ANOMALY, k + 1] - drivers[WIND_ANOMALY, k]),
            )
            fastest = fastest + v * max(wind_1, wind_1 + wind_d)
        wet_1, wet_d = 1.0, 0.0
        if wetted(balance):
            wet_1, wet_d = drivers[WETTED, k], ending * (drivers[WETTED, k + 1] - drivers[WETTED, k])
            fastest = fastest * max(wet_1, wet_1 + wet_d)
        if radiates(balance):
            _, steep = power(x, inverse)
            fastest = (1.0 - p) * fastest + p * steep
            sky_1 = drivers[AROUND, k] + f * (drivers[SKY, k] - drivers[AROUND, k])
            sky_d = drivers[AROUND, k + 1] + f * (drivers[SKY, k + 1] - drivers[AROUND, k + 1]) - sky_1
            sky_d = ending * sky_d
        if heated(balance):
            fastest = fastest + leak
        if sunny(balance):
            sun_1, sun_d = f * drivers[LIGHT, k], f * drivers[LIGHT, k + 1]
            if grounded(balance):
                sun_1 = sun_1 + (1.0 - f) * drivers[GROUND, k]
                sun_d = sun_d + (1.0 - f) * drivers[GROUND, k + 1]
            if oriented(balance):
                beam = maximum(nx * drivers[BEAM_X, k] + ny * drivers[BEAM_Y, k] + nz * drivers[BEAM_Z, k], 0.0)
                beam_2 = nx * drivers[BEAM_X, k + 1] + ny * drivers[BEAM_Y, k + 1] + nz * drivers[BEAM_Z, k + 1]
                beam_2 = maximum(beam_2, 0.0)
                if shaded(balance):
                    beam, beam_2 = beam * load_vector(lit, slots[k]), beam_2 * load_vector(lit, slots[k + 1])
                sun_1, sun_d = sun_1 + beam, sun_d + beam_2
            sun_d = ending * (sun_d - sun_1)
        settled = r * fastest * seconds
        settles = settled > STEP
        substeps = minimum(1.0 + floor(settled * (1.0 / STEP)), SUBSTEPS)
        root, root_d, whole = one, nothing, one * 4.0
        if changing(balance) and bits(settles) != 0:
            # Of a body that follows at once, a substep errs by the square of what exchange changes in it: substeps are even
            # in its fourth root, near enough to its logarithm.
            exchange, exchange_2 = one, one
            if windy(balance):
                exchange, exchange_2 = 1.0 + v * wind_1, 1.0 + v * (wind_1 + wind_d)
            if wetted(balance):
                exchange, exchange_2 = exchange * wet_1, exchange_2 * (wet_1 + wet_d)
            if radiates(balance):
                exchange, exchange_2 = (1.0 - p) * exchange + p * steep, (1.0 - p) * exchange_2 + p * steep
            if heated(balance):
                exchange, exchange_2 = exchange + leak, exchange_2 + leak
            root = select(settles, sqrt(sqrt(maximum(exchange, CALM))), one)
            root_d = select(settles, sqrt(sqrt(maximum(exchange_2, CALM))) - root, nothing)
            whole = _powers(root + root_d, root)
            folds = maximum(root_d, -root_d) / minimum(root, root + root_d)
            settling = minimum(maximum(settled - STEP, 0.0) * (1.0 / SETTLING), 1.0)
            substeps = maximum(substeps, minimum(1.0 + floor(BEND * folds * settling), GUSTS))
        share = 1.0 / substeps
        passed, rh = nothing, r * share * seconds
        for substep in range(GUSTS):
            going = substeps > substep
            if bits(going) == 0:
                break
            # Linear part: the slope of w here, and the wind halfway.
            later = share * (substep + 1)
            if changing(balance):
                later = later * _powers(root + later * root_d, root) / whole
                rh = r * (later - passed) * seconds
            air, air_2, c, c_2 = air_1 + passed * air_d, air_1 + later * air_d, one, one
            w, steep, sky, sky_2, sun, sun_2 = nothing, nothing, nothing, nothing, nothing, nothing
            wind, wind_2 = nothing, nothing
            if windy(balance):
                wind, wind_2 = wind_1 + passed * wind_d, wind_1 + later * wind_d
                c, c_2 = 1.0 + v * wind, 1.0 + v * wind_2
            wet, wet_2 = one, one
            if wetted(balance):
                wet, wet_2 = wet_1 + passed * wet_d, wet_1 + later * wet_d
                c, c_2 = c * wet, c_2 * wet_2
            if radiates(balance):
                c, c_2 = (1.0 - p) * c, (1.0 - p) * c_2
            slope, force, ahead = 0.5 * (c + c_2), c * (air - x), c_2 * (air_2 - x)
            if sunny(balance):
                sun, sun_2 = sun_1 + passed * sun_d, sun_1 + later * sun_d
                force, ahead = force + g * sun, ahead + g * sun_2
            if radiates(balance):
                sky, sky_2 = sky_1 + passed * sky_d, sky_1 + later * sky_d
                w, steep = power(x, inverse)
                slope, force, ahead = slope + p * steep, force + p * (sky - w), ahead + p * (sky_2 - w)
            if heated(balance):
                slope, force, ahead = slope + leak, force + inner - leak * x, ahead + inner - leak * x
            decay, phi, second, third = _functions(balance, slope, rh, slower, coupling)
            follows = slower * (x - y)
            if cored(balance):
                force, ahead = force - coupling * (x - y), ahead - coupling * (x - y)
            added, added_y = rh * (phi[0] * force + second[0] * (ahead - force)), nothing
            if cored(balance):
                added = added + rh * phi[2] * follows
                added_y = rh * (phi[1] * force + second[1] * (ahead - force) + phi[3] * follows)
            w_2 = w
            if changing(balance) or radiates(balance):
                # What is not linear in time or in x: the products of exchange and air, and of exchange and x, and T⁴.
                linear, w_2 = added, w
                if radiates(balance):
                    w_2, _ = power(x + added, inverse)
                added = added + rh * _bent(
                    balance, second[0], third[0], c_2 - c, air_2 - air, linear, p, steep, w_2 - w
                )
                if cored(balance):
                    rest = _bent(balance, second[1], third[1], c_2 - c, air_2 - air, linear, p, steep, w_2 - w)
                    added_y = added_y + rh * rest
            # What digits of x do not hold is added with the next substep (Kahan 1965): between samples a second apart a wall
            # changes by less than they show.
            added, added_y = added + lost, added_y + lost_y
            new, new_y = x + added, y + added_y
            lost = select(going, added - (new - x), lost)
            if cored(balance):
                lost_y = select(going, added_y - (new_y - y), lost_y)
            if sensitive(balance):
                # The linearised balance, along the trajectory from its beginning to its end. Decays at the slope of its
                # beginning, which takes 0.2 % from what derivatives are, and no second exponential.
                change = c_2 * (air_2 - new)
                if radiates(balance):
                    w_2, _ = power(new, inverse)
                    change = change + p * (sky_2 - w_2)
                if sunny(balance):
                    change = change + g * sun_2
                if heated(balance):
                    change = change + inner - leak * new
                before, after = (rh * (phi[0] - second[0]), nothing), (rh * second[0], nothing)
                if cored(balance):
                    exchanged = coupling * (new - new_y)
                    change = change - exchanged
                    before, after = (before[0], rh * (phi[1] - second[1])), (after[0], rh * second[1])
                    sooner, later_on = (
                        (rh * (phi[2] - second[2]), rh * (phi[3] - second[3])),
                        (rh * second[2], rh * second[3]),
                    )
                    d_core = _forgetting(balance, going, d_core, decay)
                    d_slower = _carried(
                        balance, going, d_slower, decay, sooner, follows, later_on, slower * (new - new_y)
                    )
                    d_coupling = _carried(
                        balance, going, d_coupling, decay, before, -coupling * (x - y), after, -exchanged
                    )
                d_rate = _carried(balance, going, d_rate, decay, before, force, after, change)
                d_start = _forgetting(balance, going, d_start, decay)
                if radiates(balance):
                    calm, calm_2 = air - x, air_2 - new
                    if windy(balance):
                        calm, calm_2 = calm * (1.0 + v * wind), calm_2 * (1.0 + v * wind_2)
                    if wetted(balance):
                        calm, calm_2 = calm * wet, calm_2 * wet_2
                    d_share = _carried(
                        balance, going, d_share, decay, before, sky - w - calm, after, sky_2 - w_2 - calm_2
                    )
                if sunny(balance):
                    d_sun = _carried(balance, going, d_sun, decay, before, sun, after, sun_2)
                if windy(balance):
                    gust, gust_2 = wind * (air - x), wind_2 * (air_2 - new)
                    if radiates(balance):
                        gust, gust_2 = (1.0 - p) * gust, (1.0 - p) * gust_2
                    if wetted(balance):
                        gust, gust_2 = gust * wet, gust_2 * wet_2
                    d_wind = _carried(balance, going, d_wind, decay, before, gust, after, gust_2)
                if heated(balance):
                    lets_out = inner * indoors >= 0.0
                    warms, warms_2 = (
                        select(lets_out, one - indoors * x, one),
                        select(lets_out, one - indoors * new, one),
                    )
                    d_inner = _carried(balance, going, d_inner, decay, before, warms, after, warms_2)
            x, y = select(going, new, x), select(going, new_y, y)
            passed = later
        if not aside:
            k += 1
            continue
        store_vector(told, 0, x)
        if sensitive(balance):
            store_vector(told, 1 + START, d_start[0])
            store_vector(told, 1 + LOG_RATE, d_rate[0])
            if radiates(balance):
                store_vector(told, 1 + share_column(balance), d_share[0])
            if sunny(balance):
                store_vector(told, 1 + sun_column(balance), d_sun[0])
            if windy(balance):
                store_vector(told, 1 + wind_column(balance), d_wind[0])
            if heated(balance):
                store_vector(told, 1 + inner_column(balance), d_inner[0])
            if cored(balance):
                column = 1 + core_column(balance)
                store_vector(told, column, d_core[0])
                store_vector(told, column + 1, d_slower[0])
                store_vector(told, column + 2, d_coupling[0])
        elif cored(balance):
            store_vector(told, 1, y)
        for j in range(min(LANES, count - group * LANES)):
            for column in range(found.shape[2]):
                found[moment, rows[group * LANES + j], column] = told[column, j]
        moment += 1
        if ending == 1.0:
            k += 1
        else:
            x, y, lost, lost_y, d_start, d_rate, d_share, d_sun, d_wind, d_inner, d_core, d_slower, d_coupling = kept


@kernel
def march(balance, first, parameters, seen, slots, rows, times, drivers, reference, indoors, moments, found):
    """Temperatures at moments under the full balance: T⁴ as it is, wind as it blows.

    dx/dt = r [g G(t) + c(t) (air - x) + p (s(t) - w(x)) + f - max(f i, 0) x + κ (y - x)] and dy/dt = μ (x - y), with w from
    ``power``, c = (1 - p) (1 + v wind_anomaly) wetted, G = a light + (1 - a) ground + V max(n · beam, 0) and s = a sky +
    (1 - a) around.
    Exponential Rosenbrock steps of third order (Hochbruck, Ostermann and Schweitzer 2009, exprb32), each interval in equal
    substeps, as many as the surface is fast. Lanes are Gaussians; what is found of one depends neither on the others nor on
    the other moments.

    Args:
        balance: the effects that there are; without an effect its terms are left out, and with a = 1 where surfaces lie
            level.
        first: sample from which they start.
        parameters: [n, P] x at that sample in kelvin above the reference, log r, then those of ``balance``; float32 or
            float64, in which all is computed. Neighbours of like rates are quickest.
        seen: [n, D] V, share of the beam that reaches them from D directions; [n, 0] where all of it does.
        slots: [T] int64 direction of the beam at each sample.
        rows: [n] int64 rows of ``found`` that they fill.
        times: [T] float64 samples.
        drivers: [10, T] float64.
        reference: R in kelvin.
        indoors: i in 1/K, of 1 over the temperature of the room behind, above the reference; 0 where f is constant.
        moments: [F] float64, increasing, within the samples from ``first`` on.
        found: [F, N, 1] filled with x, [F, N, 2] with x and y; or, of a balance that is sensitive, [F, N, 1 + Q] with x and its
            derivatives by the parameters before the normal.
    """
    parallel_for(
        _march_group,
        (rows.shape[0] + LANES - 1) // LANES,
        (balance, first, parameters, seen, slots, rows, times, drivers, reference, indoors, moments, found),
    )
