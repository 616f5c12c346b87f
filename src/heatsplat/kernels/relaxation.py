"""Temperatures of the Gaussians in view and their gradients: Newton relaxation with harmonic sources, fused.

The plain-torch twin, which also says what the symbols mean, is heatsplat.physics.relaxation (``temperature`` and
``response_slope``); heatsplat.physics.fused drives these kernels. Lanes are frequencies: a Gaussian's row of gains is
read once forward and once backward, where its gradient is written on the way. Every Gaussian is computed and written by
one thread and sums are ordered, so results do not depend on the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numba
import numpy as np
from numba import njit

from heatsplat.kernels.compilation import exact_kernel, inline, kernel
from heatsplat.kernels.scheduling import parallel_for
from heatsplat.kernels.simd import (
    LANES,
    exp,
    filled,
    load,
    load_columns,
    maximum,
    minimum,
    select,
    store,
    store_columns,
)
from heatsplat.kernels.simd import total as sum_of_lanes

BLOCK = 256  # Gaussians per parallel task: their scratch stays in the first cache
WORTH_A_SECOND_THREAD = (
    8192  # Gaussians; below, on a busy machine, waiting for the other threads costs 10 times the work
)

# Rows of the table of frequencies, [TABLE_ROWS, K padded to whole vectors]. NEAR and FAR are sinc in the difference
# sinc - φ, and OFFSET below is φ in it: for y < 1 both are counted from one, so that nothing cancels.
OMEGA, OMEGA_SQUARED, OMEGA_COSC, OMEGA_SQUARED_SINC, NEAR, FAR, X, SINC2, COSC1, COSC3 = range(10)
TABLE_ROWS = 10

# Rows of a block's scratch: functions of y = at for its Gaussians.
RATE, INITIAL, Y, PHI, OFFSET, FALL, CHI, THETA, THETA2, CHI2, RELAXED, SOURCE, SLOPE = range(13)
SCRATCH_ROWS = 13

_f = np.float32
_LARGEST_RATE = _f(1e18)  # its square still fits
_SERIES = tuple((-1) ** j / math.factorial(j + 3) for j in range(17))  # of θ2; the next term is below 5e-19
_LAST = len(_SERIES) - 1
_SPLIT = 134217729.0  # 2^27 + 1 (Dekker 1971)


@contextmanager
def threads_for(count: int) -> Iterator[None]:
    """A context in which kernels take as many threads as ``count`` Gaussians are worth."""
    before = numba.get_num_threads()
    numba.set_num_threads(before if count >= WORTH_A_SECOND_THREAD else 1)
    try:
        yield
    finally:
        numba.set_num_threads(before)


@njit
def _series(square, first):
    result, term = 0.0, 1.0
    for j in range(1, first + 1):
        term /= j
    for j in range(8):
        result += term
        term *= -square / ((first + 2 * j + 1) * (first + 2 * j + 2))
    return result


@exact_kernel  # contraction would spoil the exact product
def fill_table(omega, time, table):
    """Fills ``table`` [TABLE_ROWS, padded K] with functions of ω [K] at a time, computed in float64.

    Twin: heatsplat.physics.relaxation.phases.
    """
    table[:] = 0
    table[OMEGA] = 1  # padding divides by a² + 1
    table[OMEGA_SQUARED] = 1
    for k in range(omega.shape[0]):
        w = omega[k]
        x = w * time
        a_high, b_high = w * _SPLIT - (w * _SPLIT - w), time * _SPLIT - (time * _SPLIT - time)
        a_low, b_low = w - a_high, time - b_high
        rest = ((a_high * b_high - x) + a_high * b_low + a_low * b_high) + a_low * b_low
        sin_half = math.sin(x / 2) + rest / 2 * math.cos(x / 2)
        cos_half = math.cos(x / 2) - rest / 2 * math.sin(x / 2)
        sinc = 2 * sin_half * cos_half / x if x != 0 else 1.0
        cosc1 = 2 * (sin_half / x) ** 2 if x != 0 else 0.5
        near = abs(x) < 1
        sinc2 = _series(x * x, 3) if near else (1 - sinc) / (x * x)
        cosc3 = _series(x * x, 4) if near else (0.5 - cosc1) / (x * x)
        table[OMEGA, k] = w
        table[OMEGA_SQUARED, k] = w * w
        table[OMEGA_COSC, k] = w * x * cosc1
        table[OMEGA_SQUARED_SINC, k] = w * w * sinc
        table[NEAR, k] = -x * x * sinc2
        table[FAR, k] = sinc
        table[X, k] = x
        table[SINC2, k] = sinc2
        table[COSC1, k] = cosc1
        table[COSC3, k] = cosc3


@inline
def _fill_scratch(rate, initial, ambient, ids, start, stop, time, limit, scratch):
    """Rates, functions of y = at and temperatures without a source of the Gaussians ``ids[start:stop]``."""
    for j in range(stop - start):
        row = ids[start + j]
        scratch[RATE, j] = min(min(rate[row], limit), _LARGEST_RATE)
        scratch[INITIAL, j] = initial[row]
    for j in range(0, stop - start, LANES):
        y = load(scratch, RATE * BLOCK + j) * time
        near, far = minimum(y, 1.0), maximum(y, 1.0)
        theta2 = filled(scratch, _SERIES[_LAST])
        for term in range(_LAST):
            theta2 = theta2 * near + _SERIES[_LAST - 1 - term]
        theta = 0.5 - near * theta2
        phi_near = 1.0 - near * theta
        fall_far = exp(-far)
        phi_far = (1.0 - fall_far) / far
        small = y < 1.0
        fall = select(small, 1.0 - near * phi_near, fall_far)
        phi = select(small, phi_near, phi_far)
        first = load(scratch, INITIAL * BLOCK + j)
        above = first - ambient
        # Each side from its own end, so that time 0 gives the initial temperature exactly and late times the ambient.
        store(scratch, RELAXED * BLOCK + j, select(small, first - above * (y * phi), ambient + above * fall))
        store(scratch, Y * BLOCK + j, y)
        store(scratch, PHI * BLOCK + j, phi)
        store(scratch, OFFSET * BLOCK + j, select(small, -(near * theta), phi_far))
        store(scratch, FALL * BLOCK + j, fall)
        store(scratch, CHI * BLOCK + j, select(small, phi_near - theta, (phi_far - fall_far) / far))
        store(scratch, THETA * BLOCK + j, theta)
        store(scratch, THETA2 * BLOCK + j, theta2)
        store(scratch, CHI2 * BLOCK + j, 0.5 - (1.0 + near) * theta2)


@inline
def _heated(places, ids, start, stop, heated):
    """Fills ``heated`` with the numbers in the block of the Gaussians that have a row of gains; how many these are.

    A list, as branches that some Gaussians take and others do not cost as much as the harmonics that they save.
    """
    count = 0
    for j in range(stop - start):
        heated[count] = j
        count += places[ids[start + j]] >= 0 if places.shape[0] > 0 else 1
    return count


@inline
def _responses(table, k, width, a, phi, offset, difference_row):
    """Responses to sin and to cos over time, for sixteen frequencies from ``k``; and 1/(a² + ω²)."""
    inverse = 1.0 / (load(table, OMEGA_SQUARED * width + k) + a * a)
    damped = load(table, OMEGA_COSC * width + k)
    sine = load(table, OMEGA * width + k) * (a * (load(table, difference_row * width + k) - offset) + damped)
    cosine = a * (a * phi - damped) + load(table, OMEGA_SQUARED_SINC * width + k)
    return sine * inverse, cosine * inverse, inverse


@inline
def _forward_block(block, rate, initial, ambient, gains, places, scale, ids, time, limit, table, values):
    """``forward`` of BLOCK Gaussians."""
    count, frequencies, width = ids.shape[0], gains.shape[2], table.shape[1]
    start = block * BLOCK
    stop = min(start + BLOCK, count)
    scratch = np.empty((SCRATCH_ROWS, BLOCK), rate.dtype)
    _fill_scratch(rate, initial, ambient, ids, start, stop, time, limit, scratch)
    heated = np.empty(BLOCK, np.int64)
    for j in range(stop - start):
        values[start + j] = scratch[RELAXED, j]
    for i in range(_heated(places, ids, start, stop, heated) if frequencies > 0 else 0):
        j = heated[i]
        row = ids[start + j]
        a, y, phi, offset = scratch[RATE, j], scratch[Y, j], scratch[PHI, j], scratch[OFFSET, j]
        difference_row = NEAR if y < 1 else FAR
        place = places[row] if places.shape[0] > 0 else row
        source = filled(scratch, 0.0)
        first = place * (2 * frequencies)
        for k in range(0, frequencies, LANES):
            sine, cosine, _ = _responses(table, k, width, a, phi, offset, difference_row)
            sin_gain = load_columns(gains, first + k, 1, frequencies - k)[0]
            cos_gain = load_columns(gains, first + frequencies + k, 1, frequencies - k)[0]
            source = source + sin_gain * sine + cos_gain * cosine
        heat = time * sum_of_lanes(source)
        if scale.shape[0] > 0:
            heat = heat * scale[row]
        values[start + j] = scratch[RELAXED, j] + heat


@kernel
def forward(rate, initial, ambient, gains, places, scale, ids, time, limit, table, values):
    """Fills ``values`` [n] with the temperatures of the Gaussians ``ids``.

    Gaussians without a row of gains only relax: their frequencies are passed over.

    Args:
        rate, initial: [N] float32 or float64, as is every real number here.
        ambient: a number.
        gains: [M, 2, K].
        places: [N] int64 row of ``gains`` of every Gaussian, -1 for none; or empty, M = N: each has its own.
        scale: [N] factors on the sources, or empty for 1.
        ids: [n] int64.
        time: a number.
        limit: the largest rate used (see relaxation.bounded_rate).
        table: of ``fill_table``.
        values: [n] output.
    """
    parallel_for(
        _forward_block,
        (ids.shape[0] + BLOCK - 1) // BLOCK,
        (rate, initial, ambient, gains, places, scale, ids, time, limit, table, values),
    )


@inline
def _clear_block(block, written, v_gains):
    """Clears those of BLOCK rows that are not written."""
    for row in range(block * BLOCK, min((block + 1) * BLOCK, v_gains.shape[0])):
        if not written[row]:
            v_gains[row] = 0


@kernel
def clear_others(ids, written, v_gains):
    """Writes zeros into the rows of ``v_gains`` [M, 2, K] that are not among ``ids``, which ``backward`` leaves alone.

    Args:
        ids: [n] int64 rows of gains.
        written: [M] bool, scratch.
        v_gains: output.
    """
    count = v_gains.shape[0]
    written[:] = False
    for j in range(ids.shape[0]):
        written[ids[j]] = True
    parallel_for(_clear_block, (count + BLOCK - 1) // BLOCK, (written, v_gains))


@inline
def _backward_block(
    block,
    rate,
    initial,
    ambient,
    gains,
    places,
    scale,
    ids,
    time,
    limit,
    table,
    v_values,
    v_rate,
    v_initial,
    v_ambient,
    v_gains,
    v_scale,
):
    """``backward`` of BLOCK Gaussians."""
    count, frequencies, width = ids.shape[0], gains.shape[2], table.shape[1]
    start = block * BLOCK
    stop = min(start + BLOCK, count)
    scratch = np.empty((SCRATCH_ROWS, BLOCK), rate.dtype)
    _fill_scratch(rate, initial, ambient, ids, start, stop, time, limit, scratch)
    scratch[SOURCE] = 0
    scratch[SLOPE] = 0
    heated = np.empty(BLOCK, np.int64)
    for i in range(_heated(places, ids, start, stop, heated) if frequencies > 0 else 0):
        j = heated[i]
        row = ids[start + j]
        a, y, phi, offset = scratch[RATE, j], scratch[Y, j], scratch[PHI, j], scratch[OFFSET, j]
        fall, small = scratch[FALL, j], scratch[Y, j] < 1
        difference_row = NEAR if small else FAR
        v_gain = v_values[start + j] * time
        if scale.shape[0] > 0:
            v_gain = v_gain * scale[row]
        source, slope = filled(scratch, 0.0), filled(scratch, 0.0)
        place = places[row] if places.shape[0] > 0 else row
        first = place * (2 * frequencies)
        for k in range(0, frequencies, LANES):
            sine, cosine, inverse = _responses(table, k, width, a, phi, offset, difference_row)
            sin_gain = load_columns(gains, first + k, 1, frequencies - k)[0]
            cos_gain = load_columns(gains, first + frequencies + k, 1, frequencies - k)[0]
            store_columns(v_gains, first + k, (sine * v_gain,), frequencies - k)
            store_columns(v_gains, first + frequencies + k, (cosine * v_gain,), frequencies - k)
            source = source + sin_gain * sine + cos_gain * cosine
            if small:
                q, o = a * a * inverse, load(table, OMEGA_SQUARED * width + k) * inverse
                sinc2 = load(table, SINC2 * width + k)
                theta, theta2 = scratch[THETA, j], scratch[THETA2, j]
                inner = (q - o) * (q * theta2 + o * sinc2) - q * scratch[CHI2, j]
                inner = inner + o * o * (load(table, COSC3 * width + k) * (2.0 * y))
                sine_slope = load(table, X * width + k) * inner
                cosine_slope = (q - o) * load(table, COSC1 * width + k) + 2.0 * (o * sinc2 * y - q * theta)
                cosine_slope = cosine_slope * o - q * scratch[CHI, j]
                slope = slope + (sin_gain * sine_slope + cos_gain * cosine_slope) * time
            else:
                omega, rest = load(table, OMEGA * width + k), fall - cosine
                slope = slope + (cos_gain * (a * rest - omega * sine) - sin_gain * (a * sine + omega * rest)) * inverse
        scratch[SOURCE, j] = sum_of_lanes(source)
        scratch[SLOPE, j] = v_gain * sum_of_lanes(slope)
    ambient_sum = _f(0.0)  # becomes a double among doubles
    for j in range(stop - start):
        row, v, fall = ids[start + j], v_values[start + j], scratch[FALL, j]
        above = scratch[INITIAL, j] - ambient
        v_initial[row] = v * fall
        ambient_sum += v * (scratch[Y, j] * scratch[PHI, j])
        if scale.shape[0] > 0:
            v_scale[row] = v * time * scratch[SOURCE, j]
        if rate[row] <= limit:
            v_rate[row] = scratch[SLOPE, j] - v * above * time * fall
        else:
            v_rate[row] = 0
    v_ambient[block] = ambient_sum


@kernel
def backward(
    rate,
    initial,
    ambient,
    gains,
    places,
    scale,
    ids,
    time,
    limit,
    table,
    v_values,
    v_rate,
    v_initial,
    v_ambient,
    v_gains,
    v_scale,
):
    """Writes the rows ``ids`` of the gradients; ids must not repeat.

    Args:
        rate, initial, ambient, gains, places, scale, ids, time, limit, table: as in ``forward``.
        v_values: [n] gradient of the values.
        v_rate, v_initial, v_gains, v_scale: outputs, shaped as what they are gradients of.
        v_ambient: [blocks] output, a sum for each block of Gaussians.
    """
    parallel_for(
        _backward_block,
        (ids.shape[0] + BLOCK - 1) // BLOCK,
        (
            rate,
            initial,
            ambient,
            gains,
            places,
            scale,
            ids,
            time,
            limit,
            table,
            v_values,
            v_rate,
            v_initial,
            v_ambient,
            v_gains,
            v_scale,
        ),
    )
