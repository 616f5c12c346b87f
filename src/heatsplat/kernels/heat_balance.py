"""Heat balances of surfaces, integrated along a record of weather: one Gaussian at a time, in float64, with sensitivities.

heatsplat.physics.energy_balance and heatsplat.physics.sunlight say what the symbols mean and drive these kernels. A value
comes with its derivatives by all parameters, which obey linear equations with the same exponentials and cost a few
multiply-adds each; nothing is stored along the way. Results do not depend on the number of threads.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.compile_time import compile_time, constant
from heatsplat.kernels.scheduling import parallel_for

BLOCK = 64  # Gaussians per parallel task
SERIES_BELOW = 0.5  # of y: seven terms then leave 1e-9, and the plain quotients would cancel for small y
MEMORY = 15.0  # time constants after which a body has forgotten: e^-15 of 50 K is 2e-5 K
SUBSTEPS = 8  # of an interval between samples, at most: of bodies that settle within it
STEP = 0.35  # of y that one substep covers, if they suffice

# Rows of the drivers of ``integrate``; those of effects that are off are not read.
AIR, SKY, AROUND, LIGHT, WIND_ANOMALY, BEAM_X, BEAM_Y, BEAM_Z = range(8)
START, LOG_RATE = 0, 1  # columns of its parameters that every balance has


@compile_time
@dataclass(frozen=True)
class Balance:
    """Which effects a heat balance has beside the air; ``integrate`` is compiled for each, without a trace of the others.

    Args:
        radiates: with the share p of exchange that is radiation.
        sunny: with absorptance g.
        windy: with sensitivity v to wind.
        oriented: with normals; without them surfaces lie level.
    """

    radiates: bool
    sunny: bool
    windy: bool
    oriented: bool

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
    def normal_column(self) -> int:
        """First of the three columns of the unit normal."""
        return self.wind_column + self.windy


radiates, sunny = constant("radiates"), constant("sunny")
windy, oriented = constant("windy"), constant("oriented")
share_column, sun_column = constant("share_column"), constant("sun_column")
wind_column, normal_column = constant("wind_column"), constant("normal_column")


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
def _recent_sunlight_block(block, normals, log_rates, steps, beams, last, responses, slopes, vectors):
    """``recent_sunlight`` of BLOCK Gaussians."""
    count, intervals = log_rates.shape[0], steps.shape[0]
    for i in range(block * BLOCK, min((block + 1) * BLOCK, count)):
        nx, ny, nz = float(normals[i, 0]), float(normals[i, 1]), float(normals[i, 2])
        rate = math.exp(float(log_rates[i]))
        y, response, slope, vx, vy, vz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        bx, by, bz = beams[0, 0], beams[0, 1], beams[0, 2]
        u = nx * bx + ny * by + nz * bz
        if u <= 0.0:
            u, bx, by, bz = 0.0, 0.0, 0.0, 0.0
        seconds, decay, before, after, phi = -1.0, 1.0, 0.0, 0.0, 1.0
        for k in range(intervals):
            cx, cy, cz = beams[k + 1, 0], beams[k + 1, 1], beams[k + 1, 2]
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
def recent_sunlight(normals, log_rates, steps, beams, last, responses, slopes, vectors):
    """Settled responses to max(n · beam, 0), which is linear between samples, from rest at the first sample.

    Args:
        normals: [n, 3].
        log_rates: [n].
        steps: [K] float64 seconds between samples.
        beams: [K + 1, 3] float64 direction times strength at the samples.
        last: share of the last step that has passed; u goes that far towards its last sample.
        responses: [n] filled with Y.
        slopes: [n] filled with dY / d log a.
        vectors: [n, 3] filled with dY / dn.
    """
    parallel_for(
        _recent_sunlight_block,
        (log_rates.shape[0] + BLOCK - 1) // BLOCK,
        (normals, log_rates, steps, beams, last, responses, slopes, vectors),
    )


@inline
def power(x, reference):
    """(T⁴ - R⁴) / (4 R³) of T = R + x, and its derivative (T / R)³."""
    z = x / reference
    return x * (1.0 + z * (1.5 + z * (1.0 + 0.25 * z))), (1.0 + z) * (1.0 + z) * (1.0 + z)


@inline
def integrate_one(balance, i, parameters, times, drivers, up, reference, time, final, temperatures, sensitivities):
    """``integrate`` for the Gaussian ``i``; ``final`` is the sample before ``time``."""
    r = math.exp(float(parameters[i, LOG_RATE]))
    p, g, v, f = 0.0, 0.0, 0.0, 1.0
    nx, ny, nz = 0.0, 0.0, 0.0
    if radiates(balance):
        p = float(parameters[i, share_column(balance)])
    if sunny(balance):
        g = float(parameters[i, sun_column(balance)])
    if windy(balance):
        v = float(parameters[i, wind_column(balance)])
    if oriented(balance):
        column = normal_column(balance)
        nx, ny = float(parameters[i, column]), float(parameters[i, column + 1])
        nz = float(parameters[i, column + 2])
        f = 0.5 * (1.0 + nx * up[0] + ny * up[1] + nz * up[2])
    x = float(parameters[i, START])
    # Start at the last sample that is MEMORY time constants old (0.7: of T³ in kelvin, down to -10 % of T).
    k, age = final, 0.0
    while k > 0 and age < MEMORY:
        k -= 1
        slowest = 1.0
        if windy(balance):
            slowest += v * min(drivers[WIND_ANOMALY, k], drivers[WIND_ANOMALY, k + 1])
        if radiates(balance):
            slowest = (1.0 - p) * slowest + 0.7 * p
        age += r * slowest * (times[k + 1] - times[k])
    remembers = k == 0 and age < MEMORY
    air = drivers[AIR, k]
    c, tilt, sky, light, sun, w, w_slope = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    wind_anomaly, bx, by, bz = 0.0, 0.0, 0.0, 0.0
    if windy(balance):
        wind_anomaly = drivers[WIND_ANOMALY, k]
        c = 1.0 + v * wind_anomaly
    if sunny(balance):
        light = drivers[LIGHT, k]
        sun = f * light
        if oriented(balance):
            bx, by, bz = drivers[BEAM_X, k], drivers[BEAM_Y, k], drivers[BEAM_Z, k]
            beam = nx * bx + ny * by + nz * bz
            if beam <= 0.0:
                beam, bx, by, bz = 0.0, 0.0, 0.0, 0.0
            sun += beam
    if not remembers:
        x = air
        if sunny(balance):
            x += g * sun
    if radiates(balance):
        c *= 1.0 - p
        tilt = drivers[SKY, k] - drivers[AROUND, k]
        sky = drivers[AROUND, k] + f * tilt
        w, w_slope = power(x, reference)
    d_start, d_rate, d_share, d_sun, d_wind, dx, dy, dz = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    while k <= final:
        interval = times[k + 1] - times[k]
        ending = 1.0
        if k == final:
            ending = (time - times[k]) / interval
        seconds = interval * ending
        # Differences to the end of the interval, and the fastest that the body can be within it.
        d_air = drivers[AIR, k + 1] - air
        d_wind_anomaly, d_tilt, d_sky, d_level, d_light = 0.0, 0.0, 0.0, 0.0, 0.0
        ex, ey, ez = 0.0, 0.0, 0.0
        fastest = 1.0
        if windy(balance):
            d_wind_anomaly = drivers[WIND_ANOMALY, k + 1] - wind_anomaly
            fastest += v * max(wind_anomaly, wind_anomaly + d_wind_anomaly)
        if radiates(balance):
            fastest = (1.0 - p) * fastest + p * w_slope
            tilt_2 = drivers[SKY, k + 1] - drivers[AROUND, k + 1]
            d_tilt, d_sky = tilt_2 - tilt, drivers[AROUND, k + 1] + f * tilt_2 - sky
        if sunny(balance):
            light_2 = drivers[LIGHT, k + 1]
            sun_2 = f * light_2
            if oriented(balance):
                cx, cy, cz = drivers[BEAM_X, k + 1], drivers[BEAM_Y, k + 1], drivers[BEAM_Z, k + 1]
                beam = nx * cx + ny * cy + nz * cz
                if beam <= 0.0:
                    beam, cx, cy, cz = 0.0, 0.0, 0.0, 0.0
                sun_2 += beam
                ex, ey, ez = cx - bx, cy - by, cz - bz
            d_level, d_light = light_2 - light, sun_2 - sun
        substeps = min(SUBSTEPS, 1 + int(r * fastest * seconds / STEP))
        share = ending / substeps
        h = seconds / substeps
        for _ in range(substeps):
            # Linear part: the slope of w here, and the wind halfway.
            air_2, c_2 = air + share * d_air, c
            wind_anomaly_2, tilt_2, sky_2, light_2, sun_2 = wind_anomaly, tilt, sky, light, sun
            if windy(balance):
                wind_anomaly_2 = wind_anomaly + share * d_wind_anomaly
                c_2 = 1.0 + v * wind_anomaly_2
                if radiates(balance):
                    c_2 *= 1.0 - p
            slope, force, ahead = 0.5 * (c + c_2), c * (air - x), c_2 * (air_2 - x)
            if sunny(balance):
                light_2, sun_2 = light + share * d_level, sun + share * d_light
                force += g * sun
                ahead += g * sun_2
            if radiates(balance):
                tilt_2, sky_2 = tilt + share * d_tilt, sky + share * d_sky
                slope += p * w_slope
                force += p * (sky - w)
                ahead += p * (sky_2 - w)
            decay, phi, second, third = weights(r * slope * h)
            new = x + h * r * (phi * force + second * (ahead - force))
            rest = (slope - c_2) * (new - x)
            w_2, slope_2 = 0.0, 0.0
            if radiates(balance):
                w_2, slope_2 = power(new, reference)
                rest -= p * (w_2 - w)
            if windy(balance) or radiates(balance):
                new += 2.0 * third * h * r * rest
            slope = c + c_2
            if radiates(balance):
                w_2, slope_2 = power(new, reference)
                slope += p * (w_slope + slope_2)
            # Sensitivities: the linearised balance, along the trajectory from its beginning to its end.
            decay, phi, second, _ = weights(h * r * 0.5 * slope)
            one, two = h * r * (phi - second), h * r * second
            change = c_2 * (air_2 - new)
            if sunny(balance):
                change += g * sun_2
            if radiates(balance):
                change += p * (sky_2 - w_2)
            d_rate = decay * d_rate + one * force + two * change
            d_start *= decay
            if radiates(balance):
                calm, calm_2 = air - x, air_2 - new
                if windy(balance):
                    calm *= 1.0 + v * wind_anomaly
                    calm_2 *= 1.0 + v * wind_anomaly_2
                d_share = decay * d_share + one * (sky - w - calm) + two * (sky_2 - w_2 - calm_2)
            if sunny(balance):
                d_sun = decay * d_sun + one * sun + two * sun_2
            if windy(balance):
                gust = one * wind_anomaly * (air - x) + two * wind_anomaly_2 * (air_2 - new)
                if radiates(balance):
                    gust *= 1.0 - p
                d_wind = decay * d_wind + gust
            if oriented(balance):
                lean = 0.0
                if radiates(balance):
                    lean += p * (one * tilt + two * tilt_2)
                if sunny(balance):
                    lean += g * (one * light + two * light_2)
                lean *= 0.5
                dx = decay * dx + lean * up[0]
                dy = decay * dy + lean * up[1]
                dz = decay * dz + lean * up[2]
                if sunny(balance):
                    cx, cy, cz = bx + share * ex, by + share * ey, bz + share * ez
                    dx += g * (one * bx + two * cx)
                    dy += g * (one * by + two * cy)
                    dz += g * (one * bz + two * cz)
                    bx, by, bz = cx, cy, cz
            x, air, c = new, air_2, c_2
            w, w_slope, wind_anomaly, tilt, sky, light, sun = (
                w_2,
                slope_2,
                wind_anomaly_2,
                tilt_2,
                sky_2,
                light_2,
                sun_2,
            )
        k += 1
    temperatures[i] = x
    sensitivities[i, START] = d_start if remembers else 0.0
    sensitivities[i, LOG_RATE] = d_rate
    if radiates(balance):
        sensitivities[i, share_column(balance)] = d_share
    if sunny(balance):
        sensitivities[i, sun_column(balance)] = d_sun
    if windy(balance):
        sensitivities[i, wind_column(balance)] = d_wind
    if oriented(balance):
        column = normal_column(balance)
        sensitivities[i, column], sensitivities[i, column + 1] = dx, dy
        sensitivities[i, column + 2] = dz


@inline
def _integrate_block(
    block, balance, parameters, times, drivers, up, reference, time, final, temperatures, sensitivities
):
    """``integrate`` of BLOCK Gaussians; ``final`` is the sample before ``time``."""
    count = parameters.shape[0]
    for i in range(block * BLOCK, min((block + 1) * BLOCK, count)):
        integrate_one(balance, i, parameters, times, drivers, up, reference, time, final, temperatures, sensitivities)


@kernel
def integrate(balance, parameters, times, drivers, up, reference, time, temperatures, sensitivities):
    """Temperatures at a time under the full balance: T⁴ as it is, wind as it blows.

    dx/dt = r [g G(t) + c(t) (air - x) + p (s(t) - w(x))] with w from ``power``, c = (1 - p) (1 + v wind_anomaly), G = light f +
    max(n · beam, 0), s = f sky + (1 - f) around and f = (1 + n · up) / 2. Exponential Rosenbrock steps of third order
    (Hochbruck, Ostermann and Schweitzer 2009, exprb32), each interval in equal substeps, as many as the body is fast. A
    body starts where it can still be remembered.

    Args:
        balance: the effects that there are; without an effect its terms are left out, and with f = 1 where surfaces lie
            level.
        parameters: [n, P] x at the first sample in kelvin above the reference, log r, then those of ``balance``.
        times: [T] float64 samples.
        drivers: [8, T] float64.
        up: [3] direction away from the ground.
        reference: R in kelvin.
        time: moment asked for, within the samples.
        temperatures: [n] filled with x.
        sensitivities: [n, P] filled with the derivatives of x by the parameters.
    """
    final = times.shape[0] - 2
    while final > 0 and times[final] >= time:
        final -= 1
    parallel_for(
        _integrate_block,
        (parameters.shape[0] + BLOCK - 1) // BLOCK,
        (balance, parameters, times, drivers, up, reference, time, final, temperatures, sensitivities),
    )
