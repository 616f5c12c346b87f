"""Heat balances of surfaces, marched along a record of weather: one Gaussian at a time, in float64, with sensitivities.

heatsplat.physics.energy_balance and heatsplat.physics.sunlight say what the symbols mean and drive these kernels. A value
comes with its derivatives by all parameters, which obey linear equations with the same exponentials and cost a few
multiply-adds each; nothing is stored along the way. Results do not depend on the number of threads.
"""

from __future__ import annotations

import math

from numba import prange

from heatsplat.kernels.compilation import inline, kernel

BLOCK = 64  # Gaussians per parallel task
SERIES_BELOW = 0.5  # of y: seven terms then leave 1e-9, and the plain quotients would cancel for small y
MEMORY = 15.0  # time constants after which a body has forgotten: e^-15 of 50 K is 2e-5 K
SUBSTEPS = 8  # of an interval between samples, at most: of bodies that settle within it
STEP = 0.35  # of y that one substep covers, if they suffice

# Columns of the parameters of ``march`` and of the sensitivities that it returns.
START, LOG_RATE, SHARE, SUN, WIND, NX, NY, NZ = range(8)
PARAMETERS = 8
# Rows of its drivers.
AIR, SKY, AROUND, LIGHT, BREEZE, BEAM_X, BEAM_Y, BEAM_Z = range(8)


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
    count, intervals = log_rates.shape[0], steps.shape[0]
    for block in prange((count + BLOCK - 1) // BLOCK):
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


@inline
def power(x, reference):
    """(T⁴ - R⁴) / (4 R³) of T = R + x, and its derivative (T / R)³."""
    z = x / reference
    return x * (1.0 + z * (1.5 + z * (1.0 + 0.25 * z))), (1.0 + z) * (1.0 + z) * (1.0 + z)


@kernel
def march(parameters, times, drivers, up, oriented, reference, radiation, time, temperatures, sensitivities):
    """Temperatures at a time under the full balance: T⁴ as it is, wind as it blows.

    dx/dt = r [g G(t) + c(t) (air - x) + p (s(t) - w(x))] with w from ``power``, c = (1 - p) (1 + v breeze), G = light f +
    max(n · beam, 0), s = f sky + (1 - f) around and f = (1 + n · up) / 2. Exponential Rosenbrock steps of third order
    (Hochbruck, Ostermann and Schweitzer 2009, exprb32), each interval in equal substeps, as many as the body is fast. A
    body starts where it can still be remembered.

    Args:
        parameters: [n, 8] x at the first sample in kelvin above the reference, log r, p, g, v and the unit normal n.
        times: [T] float64 samples.
        drivers: [8, T] float64; rows of missing drivers are zero.
        up: [3] direction away from the ground.
        oriented: whether normals count; without, G = light and s = sky.
        reference: R in kelvin.
        radiation: 1.0, or 0.0 to leave out w and s; p is then 0.
        time: moment asked for, within the samples.
        temperatures: [n] filled with x.
        sensitivities: [n, 8] filled with the derivatives of x by the parameters.
    """
    count = parameters.shape[0]
    final = times.shape[0] - 2
    while final > 0 and times[final] >= time:
        final -= 1
    for block in prange((count + BLOCK - 1) // BLOCK):
        for i in range(block * BLOCK, min((block + 1) * BLOCK, count)):
            r = math.exp(float(parameters[i, LOG_RATE]))
            p, g, v = float(parameters[i, SHARE]), float(parameters[i, SUN]), float(parameters[i, WIND])
            nx, ny, nz = float(parameters[i, NX]), float(parameters[i, NY]), float(parameters[i, NZ])
            f = 1.0
            if oriented:
                f = 0.5 * (1.0 + nx * up[0] + ny * up[1] + nz * up[2])
            x = float(parameters[i, START])
            # Start at the last sample that is MEMORY time constants old (0.7: of T³ in kelvin, down to -10 % of T).
            k, age = final, 0.0
            while k > 0 and age < MEMORY:
                k -= 1
                slowest = (1.0 - p) * (1.0 + v * min(drivers[BREEZE, k], drivers[BREEZE, k + 1])) + 0.7 * p
                age += r * slowest * (times[k + 1] - times[k])
            remembers = k == 0 and age < MEMORY
            air, breeze = drivers[AIR, k], drivers[BREEZE, k]
            bx, by, bz = drivers[BEAM_X, k], drivers[BEAM_Y, k], drivers[BEAM_Z, k]
            beam = nx * bx + ny * by + nz * bz
            if beam <= 0.0:
                beam, bx, by, bz = 0.0, 0.0, 0.0, 0.0
            light = drivers[LIGHT, k]
            sun = f * light + beam
            tilt = radiation * (drivers[SKY, k] - drivers[AROUND, k])
            sky = radiation * drivers[AROUND, k] + f * tilt
            if not remembers:
                x = air + g * sun
            d_start, d_rate, d_share, d_sun, d_wind, dx, dy, dz = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
            w, w_slope = power(x, reference)
            w *= radiation
            w_slope *= radiation
            while k <= final:
                interval = times[k + 1] - times[k]
                ending = 1.0
                if k == final:
                    ending = (time - times[k]) / interval
                seconds = interval * ending
                air_2, breeze_2 = drivers[AIR, k + 1], drivers[BREEZE, k + 1]
                cx, cy, cz = drivers[BEAM_X, k + 1], drivers[BEAM_Y, k + 1], drivers[BEAM_Z, k + 1]
                beam = nx * cx + ny * cy + nz * cz
                if beam <= 0.0:
                    beam, cx, cy, cz = 0.0, 0.0, 0.0, 0.0
                light_2 = drivers[LIGHT, k + 1]
                sun_2 = f * light_2 + beam
                tilt_2 = radiation * (drivers[SKY, k + 1] - drivers[AROUND, k + 1])
                sky_2 = radiation * drivers[AROUND, k + 1] + f * tilt_2
                fastest = r * ((1.0 - p) * (1.0 + v * max(breeze, breeze_2)) + p * w_slope)
                substeps = min(SUBSTEPS, 1 + int(fastest * seconds / STEP))
                share = ending / substeps
                d_air, d_breeze, d_sky, d_light = air_2 - air, breeze_2 - breeze, sky_2 - sky, sun_2 - sun
                d_tilt, d_level = tilt_2 - tilt, light_2 - light
                ex, ey, ez = cx - bx, cy - by, cz - bz
                h = seconds / substeps
                for _ in range(substeps):
                    air_2, breeze_2 = air + share * d_air, breeze + share * d_breeze
                    sky_2, sun_2 = sky + share * d_sky, sun + share * d_light
                    tilt_2, light_2 = tilt + share * d_tilt, light + share * d_level
                    cx, cy, cz = bx + share * ex, by + share * ey, bz + share * ez
                    # Linear part: the slope of w here, and the wind halfway.
                    c, c_2 = (1.0 - p) * (1.0 + v * breeze), (1.0 - p) * (1.0 + v * breeze_2)
                    a = r * (0.5 * (c + c_2) + p * w_slope)
                    decay, phi, second, third = weights(a * h)
                    force = r * (g * sun + c * (air - x) + p * (sky - w))
                    ahead = r * (g * sun_2 + c_2 * (air_2 - x) + p * (sky_2 - w))
                    guess = x + h * (phi * force + second * (ahead - force))
                    w_2, slope_2 = power(guess, reference)
                    rest = r * (-c_2 * (guess - x) - p * (radiation * w_2 - w)) + a * (guess - x)
                    new = guess + h * 2.0 * third * rest
                    w_2, slope_2 = power(new, reference)
                    w_2 *= radiation
                    slope_2 *= radiation
                    # Sensitivities: the linearised balance, along the trajectory from its beginning to its end.
                    decay, phi, second, _ = weights(h * r * 0.5 * (c + p * w_slope + c_2 + p * slope_2))
                    one, two = h * (phi - second), h * second
                    rate_1 = g * sun + c * (air - x) + p * (sky - w)
                    rate_2 = g * sun_2 + c_2 * (air_2 - new) + p * (sky_2 - w_2)
                    d_rate = decay * d_rate + r * (one * rate_1 + two * rate_2)
                    share_1 = sky - w - (1.0 + v * breeze) * (air - x)
                    share_2 = sky_2 - w_2 - (1.0 + v * breeze_2) * (air_2 - new)
                    d_share = decay * d_share + r * (one * share_1 + two * share_2)
                    d_sun = decay * d_sun + r * (one * sun + two * sun_2)
                    d_wind = decay * d_wind + r * (1.0 - p) * (
                        one * breeze * (air - x) + two * breeze_2 * (air_2 - new)
                    )
                    lean = 0.5 * r * (one * (g * light + p * tilt) + two * (g * light_2 + p * tilt_2))
                    dx = decay * dx + r * g * (one * bx + two * cx) + lean * up[0]
                    dy = decay * dy + r * g * (one * by + two * cy) + lean * up[1]
                    dz = decay * dz + r * g * (one * bz + two * cz) + lean * up[2]
                    d_start *= decay
                    x, w, w_slope = new, w_2, slope_2
                    air, breeze, sky, sun, tilt, light = air_2, breeze_2, sky_2, sun_2, tilt_2, light_2
                    bx, by, bz = cx, cy, cz
                k += 1
            temperatures[i] = x
            sensitivities[i, START] = d_start if remembers else 0.0
            sensitivities[i, LOG_RATE], sensitivities[i, SHARE] = d_rate, d_share
            sensitivities[i, SUN], sensitivities[i, WIND] = d_sun, d_wind
            if oriented:
                sensitivities[i, NX], sensitivities[i, NY], sensitivities[i, NZ] = dx, dy, dz
            else:
                sensitivities[i, NX], sensitivities[i, NY], sensitivities[i, NZ] = 0.0, 0.0, 0.0
