"""Responses of oriented surfaces to the sun's beam, with derivatives: what heatsplat.physics.sunlight asks of each Gaussian.

Results do not depend on the number of threads.
"""

from __future__ import annotations

import math

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.scheduling import parallel_for

BLOCK = 64  # Gaussians per parallel task
SERIES_BELOW = 0.5  # of y: seven terms then leave 1e-9, and the plain quotients would cancel for small y


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
