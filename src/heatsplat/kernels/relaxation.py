"""Temperatures of the Gaussians in view and their gradients: Newton relaxation with harmonic sources, fused.

The plain-torch twin, which also says what the symbols mean, is heatsplat.physics.relaxation (``temperature`` and
``response_slope``); heatsplat.physics.fused drives these kernels. Lanes are frequencies. ``forward`` reads a Gaussian's row
of gains and finds values and slopes in one go, so that ``backward`` needs no gains. The gradient of a row of gains is one
number times the responses of its Gaussian: ``write_gains`` writes it out, summed over views, ``step_gains`` is Adam's step
with it, which reads and writes gains and moments once and the gradient never. Every row is computed and written by one
thread and sums are ordered, so results do not depend on the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import numba
import numpy as np
from numba import njit

from heatsplat.kernels.adam import SQUARED_ROWS, square_rows, updated
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
    prefetch,
    select,
    store,
    store_columns,
)
from heatsplat.kernels.simd import total as sum_of_lanes

BLOCK = SQUARED_ROWS // 2  # Gaussians per parallel task: their scratch stays in the first cache
WORTH_A_SECOND_THREAD = (
    8192  # Gaussians; below, on a busy machine, waiting for the other threads costs 10 times the work
)
AHEAD = 1024  # gains that are asked for before their turn: Adam has driven them out of the cache (measured: half of the time)

# Rows of the table of frequencies, [TABLE_ROWS, K padded to whole vectors]. NEAR and FAR are sinc in the difference
# sinc - φ, and OFFSET below is φ in it: for y < 1 both are counted from one, so that nothing cancels.
OMEGA, OMEGA_SQUARED, OMEGA_COSC, OMEGA_SQUARED_SINC, NEAR, FAR, X, SINC2, COSC1, COSC3 = range(10)
TABLE_ROWS = 10

# Rows of a block's scratch: of each Gaussian its rate, its slope by what it is given as, its initial temperature, functions of
# y = at, the temperature without a source, the source over time, and its slope by the rate.
RATE, FREE, INITIAL, Y, PHI, OFFSET, FALL, CHI, THETA, THETA2, CHI2, RELAXED, SOURCE, SLOPE = range(14)
SCRATCH_ROWS = 14

# Rows of what ``forward`` leaves for ``backward``: slopes of the value, and the rate that was used.
BY_RATE, BY_INITIAL, BY_AMBIENT, BY_SCALE, USED_RATE = range(5)
SLOPES = 5

# Rows of what ``backward`` leaves of the gradient of gains.
RATES, PULLS = 0, 1

_f = np.float32
_LARGEST_RATE = _f(1e18)  # its square still fits
_SERIES = tuple((-1) ** j / math.factorial(j + 3) for j in range(17))  # of θ2; the next term is below 5e-19
_LAST = len(_SERIES) - 1
_SPLIT = 134217729.0  # 2^27 + 1 (Dekker 1971)


@contextmanager
def threads_for(count: int) -> Iterator[None]:
    """A context in which kernels take as many threads as ``count`` Gaussians are worth."""
    if count >= WORTH_A_SECOND_THREAD:
        yield
        return
    before = numba.get_num_threads()
    numba.set_num_threads(1)
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
def _fill_functions(count, time, scratch):
    """Functions of y = at of the first Gaussians of a block, whose rates are in its scratch."""
    for j in range(0, count, LANES):
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
        store(scratch, Y * BLOCK + j, y)
        store(scratch, PHI * BLOCK + j, select(small, phi_near, phi_far))
        store(scratch, OFFSET * BLOCK + j, select(small, -(near * theta), phi_far))
        store(scratch, FALL * BLOCK + j, select(small, 1.0 - near * phi_near, fall_far))
        store(scratch, CHI * BLOCK + j, select(small, phi_near - theta, (phi_far - fall_far) / far))
        store(scratch, THETA * BLOCK + j, theta)
        store(scratch, THETA2 * BLOCK + j, theta2)
        store(scratch, CHI2 * BLOCK + j, 0.5 - (1.0 + near) * theta2)


@inline
def _fill_scratch(rate, bounds, initial, ambient, ids, start, stop, time, limit, scratch):
    """What a block knows of the Gaussians ``ids[start:stop]`` before it looks at gains."""
    for j in range(stop - start):
        row = ids[start + j]
        scratch[RATE, j] = rate[row]
        scratch[INITIAL, j] = initial[row]
    for j in range(0, stop - start, LANES):
        given = load(scratch, RATE * BLOCK + j)
        if bounds.shape[0] > 0:
            a = exp(minimum(maximum(given, bounds[0]), bounds[1]))
            free = select((given >= bounds[0]) & (given <= bounds[1]) & (a <= limit), a, 0.0)
        else:
            a, free = given, select(given <= limit, filled(scratch, 1.0), 0.0)
        store(scratch, FREE * BLOCK + j, free)
        store(scratch, RATE * BLOCK + j, minimum(minimum(a, limit), _LARGEST_RATE))
    _fill_functions(stop - start, time, scratch)
    for j in range(0, stop - start, LANES):
        y, first = load(scratch, Y * BLOCK + j), load(scratch, INITIAL * BLOCK + j)
        above = first - ambient
        # Each side from its own end, so that time 0 gives the initial temperature exactly and late times the ambient.
        near = first - above * (y * load(scratch, PHI * BLOCK + j))
        store(scratch, RELAXED * BLOCK + j, select(y < 1.0, near, ambient + above * load(scratch, FALL * BLOCK + j)))
    scratch[SOURCE] = 0
    scratch[SLOPE] = 0


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
def _response_slopes(table, k, width, j, scratch, sine, cosine, inverse):
    """Slopes by rate of the responses to sin and to cos, not over time, for sixteen frequencies from ``k``, y >= 1."""
    a, rest = scratch[RATE, j], scratch[FALL, j] - cosine
    omega = load(table, OMEGA * width + k)
    return -(a * sine + omega * rest) * inverse, (a * rest - omega * sine) * inverse


@inline
def _near_response_slopes(table, k, width, j, scratch, inverse):
    """As ``_response_slopes`` for y < 1, over time."""
    a, y, theta, theta2 = scratch[RATE, j], scratch[Y, j], scratch[THETA, j], scratch[THETA2, j]
    q, o = a * a * inverse, load(table, OMEGA_SQUARED * width + k) * inverse
    sinc2 = load(table, SINC2 * width + k)
    inner = (q - o) * (q * theta2 + o * sinc2) - q * scratch[CHI2, j]
    inner = inner + o * o * (load(table, COSC3 * width + k) * (2.0 * y))
    cosine_slope = (q - o) * load(table, COSC1 * width + k) + 2.0 * (o * sinc2 * y - q * theta)
    return load(table, X * width + k) * inner, cosine_slope * o - q * scratch[CHI, j]


@inline
def _heat(j, place, gains, time, table, sloping, scratch):
    """Source over time of one Gaussian of a block, and its slope by the rate where that is wanted, into the scratch."""
    frequencies, width, first = gains.shape[2], table.shape[1], place * (2 * gains.shape[2])
    a, phi, offset, small = scratch[RATE, j], scratch[PHI, j], scratch[OFFSET, j], scratch[Y, j] < 1
    difference_row = NEAR if small else FAR
    source, slope = filled(scratch, 0.0), filled(scratch, 0.0)
    for k in range(0, 2 * frequencies, LANES):
        prefetch(gains, first + AHEAD + k)
    for k in range(0, frequencies, LANES):
        sine, cosine, inverse = _responses(table, k, width, a, phi, offset, difference_row)
        sin_gain = load_columns(gains, first + k, 1, frequencies - k)[0]
        cos_gain = load_columns(gains, first + frequencies + k, 1, frequencies - k)[0]
        source = source + sin_gain * sine + cos_gain * cosine
        if sloping:
            if small:
                by_sine, by_cosine = _near_response_slopes(table, k, width, j, scratch, inverse)
            else:
                by_sine, by_cosine = _response_slopes(table, k, width, j, scratch, sine, cosine, inverse)
            slope = slope + sin_gain * by_sine + cos_gain * by_cosine
    scratch[SOURCE, j] = sum_of_lanes(source)
    if sloping:
        scratch[SLOPE, j] = sum_of_lanes(slope) * time if small else sum_of_lanes(slope)


@inline
def _forward_block(
    block, rate, bounds, initial, ambient, gains, places, scale, ids, time, limit, table, values, slopes
):  # fmt: skip
    """``forward`` of BLOCK Gaussians."""
    start, count, sloping = block * BLOCK, ids.shape[0], slopes.shape[0] > 0
    stop = min(start + BLOCK, count)
    scratch = np.empty((SCRATCH_ROWS, BLOCK), initial.dtype)
    _fill_scratch(rate, bounds, initial, ambient, ids, start, stop, time, limit, scratch)
    heated = np.empty(BLOCK, np.int64)
    for i in range(_heated(places, ids, start, stop, heated) if gains.shape[2] > 0 else 0):
        row = ids[start + heated[i]]
        _heat(heated[i], places[row] if places.shape[0] > 0 else row, gains, time, table, sloping, scratch)
    if scale.shape[0] > 0:
        for j in range(stop - start):
            factor = scale[ids[start + j]]
            if sloping:
                slopes[BY_SCALE, start + j] = time * scratch[SOURCE, j]
            scratch[SOURCE, j] *= factor
            scratch[SLOPE, j] *= factor
    for j in range(0, stop - start, LANES):
        rows = stop - start - j
        heat = time * load(scratch, SOURCE * BLOCK + j)
        store_columns(values, start + j, (load(scratch, RELAXED * BLOCK + j) + heat,), rows)
        if sloping:
            fall, free = load(scratch, FALL * BLOCK + j), load(scratch, FREE * BLOCK + j)
            above = load(scratch, INITIAL * BLOCK + j) - ambient
            by_rate = time * load(scratch, SLOPE * BLOCK + j) - above * time * fall
            by_ambient = load(scratch, Y * BLOCK + j) * load(scratch, PHI * BLOCK + j)
            store_columns(slopes, BY_RATE * count + start + j, (select(free > 0.0, by_rate * free, 0.0),), rows)
            store_columns(slopes, BY_INITIAL * count + start + j, (fall,), rows)
            store_columns(slopes, BY_AMBIENT * count + start + j, (by_ambient,), rows)
            store_columns(slopes, USED_RATE * count + start + j, (load(scratch, RATE * BLOCK + j),), rows)


@kernel
def forward(rate, bounds, initial, ambient, gains, places, scale, ids, time, limit, table, values, slopes):
    """Fills ``values`` [n] with the temperatures of the Gaussians ``ids``, and ``slopes`` with what ``backward`` needs.

    Gaussians without a row of gains only relax: their frequencies are passed over.

    Args:
        rate, initial: [N] float32 or float64, as is every real number here.
        bounds: empty; or [2], and ``rate`` holds logarithms, which are taken within them.
        ambient: a number.
        gains: [M, 2, K].
        places: [N] int64 row of ``gains`` of every Gaussian, -1 for none; or empty, M = N: each has its own.
        scale: [N] factors on the sources, or empty for 1.
        ids: [n] int64.
        time: a number.
        limit: the largest rate used (see relaxation.bounded_rate).
        table: of ``fill_table``.
        values: [n] output.
        slopes: [SLOPES, n] output, or [0, 0] where they are not wanted.
    """
    parallel_for(
        _forward_block, (ids.shape[0] + BLOCK - 1) // BLOCK,
        (rate, bounds, initial, ambient, gains, places, scale, ids, time, limit, table, values, slopes),
    )  # fmt: skip


@inline
def _backward_block(
    block, ids, places, scale, time, slopes, v_values, v_rate, v_initial, v_ambient, v_scale, rows
):  # fmt: skip
    """``backward`` of BLOCK Gaussians."""
    ambient_sum = _f(0.0)  # becomes a double among doubles
    for j in range(block * BLOCK, min((block + 1) * BLOCK, ids.shape[0])):
        row, v = ids[j], v_values[j]
        v_rate[row] = v * slopes[BY_RATE, j]
        v_initial[row] = v * slopes[BY_INITIAL, j]
        ambient_sum += v * slopes[BY_AMBIENT, j]
        pull = v * time
        if scale.shape[0] > 0:
            v_scale[row] = v * slopes[BY_SCALE, j]
            pull = pull * scale[row]
        if rows.shape[1] > 0:
            place = places[row] if places.shape[0] > 0 else row
            if place >= 0:
                rows[RATES, place] = slopes[USED_RATE, j]
                rows[PULLS, place] = pull
    v_ambient[block] = ambient_sum


@kernel
def backward(ids, places, scale, time, slopes, v_values, v_rate, v_initial, v_ambient, v_scale, rows):
    """Writes the rows ``ids`` of the gradients; ids must not repeat.

    Args:
        ids, places, scale, time: as in ``forward``, which left ``slopes``.
        v_values: [n] gradient of the values.
        v_rate, v_initial, v_scale: outputs, shaped as what they are gradients of.
        v_ambient: [blocks] output, a sum for each block of Gaussians.
        rows: [2, M] output, of each row of gains that is seen the rate of its Gaussian (RATES) and what its responses
            are multiplied by for the gradient (PULLS); or [2, 0] where there are no gains.
    """
    parallel_for(
        _backward_block, v_ambient.shape[0],
        (ids, places, scale, time, slopes, v_values, v_rate, v_initial, v_ambient, v_scale, rows),
    )  # fmt: skip


@inline
def _fill_rows(block, view, rows, time, scratch):
    """Rates, and functions of y = at, of the rows of a block, if the view sees any; whether it does."""
    start = block * BLOCK
    count, seen = min(BLOCK, rows.shape[2] - start), False
    for j in range(count):
        scratch[RATE, j] = rows[view, RATES, start + j]
        seen = seen or rows[view, PULLS, start + j] != 0
    if seen:
        _fill_functions(count, time, scratch)
    return seen


@inline
def _row_gradient(pull, j, k, time, table, scratch):
    """Gradients of the gains of sin and of cos of row ``j`` of a block, for sixteen frequencies from ``k``."""
    difference_row = NEAR if scratch[Y, j] < 1 else FAR
    sine, cosine, _ = _responses(
        table, k, table.shape[1], scratch[RATE, j], scratch[PHI, j], scratch[OFFSET, j], difference_row
    )
    return sine * pull, cosine * pull


@inline
def _sum_rows(block, rows, times, tables, frequencies, scratch, out, place):
    """Writes the gradient of a block's rows, summed over views, from ``place`` of ``out`` on; how many rows it has."""
    count, begin = min(BLOCK, rows.shape[2] - block * BLOCK), place
    for k in range(0, count * 2 * frequencies, LANES):
        store_columns(out, begin + k, (filled(scratch, 0.0),), count * 2 * frequencies - k)
    for view in range(rows.shape[0]):
        if not _fill_rows(block, view, rows, times[view], scratch):
            continue
        for j in range(count):
            pull, place = rows[view, PULLS, block * BLOCK + j], begin + j * 2 * frequencies
            for k in range(0, frequencies if pull != 0 else 0, LANES):
                by_sine, by_cosine = _row_gradient(pull, j, k, times[view], tables[view], scratch)
                rest = frequencies - k
                (sine,), (cosine,) = (
                    load_columns(out, place + k, 1, rest),
                    load_columns(out, place + frequencies + k, 1, rest),
                )
                store_columns(out, place + k, (sine + by_sine,), rest)
                store_columns(out, place + frequencies + k, (cosine + by_cosine,), rest)
    return count


@inline
def _write_block(block, rows, times, tables, v_gains):
    """``write_gains`` of BLOCK rows."""
    scratch, frequencies = np.empty((SCRATCH_ROWS, BLOCK), v_gains.dtype), v_gains.shape[2]
    _sum_rows(block, rows, times, tables, frequencies, scratch, v_gains, block * BLOCK * 2 * frequencies)


@kernel
def write_gains(rows, times, tables, v_gains):
    """Writes the gradient of gains [M, 2, K], summed over views: all rows, zeros where no view pulls.

    Args:
        rows: [views, 2, M], RATES and PULLS of ``backward``.
        times, tables: [views], [views, TABLE_ROWS, padded K], of ``forward``.
        v_gains: output.
    """
    parallel_for(_write_block, (rows.shape[2] + BLOCK - 1) // BLOCK, (rows, times, tables, v_gains))


@inline
def _step_block(block, rows, times, tables, gains, first, second, decay, rates, sums, squares):
    """``step_gains`` of BLOCK rows."""
    scratch, frequencies = np.empty((SCRATCH_ROWS, BLOCK), gains.dtype), gains.shape[2]
    gradient = np.empty(BLOCK * 2 * frequencies, gains.dtype)  # stays in the first cache
    count = _sum_rows(block, rows, times, tables, frequencies, scratch, gradient, 0)
    begin, numbers, period = block * BLOCK * 2 * frequencies, count * 2 * frequencies, decay.shape[0]
    added, phase = filled(scratch, 0.0), 0
    for k in range(0, numbers, LANES):
        rest, decays = numbers - k, load(decay, phase)
        (x,), (m,) = load_columns(gains, begin + k, 1, rest), load_columns(first, begin + k, 1, rest)
        (v,), (g,) = load_columns(second, begin + k, 1, rest), load_columns(gradient, k, 1, rest)
        x, m, v = updated(x, g, m, v, decays, rates)
        store_columns(gains, begin + k, (x,), rest)
        store_columns(first, begin + k, (m,), rest)
        store_columns(second, begin + k, (v,), rest)
        added = added + x
        phase = phase + LANES if phase + LANES < period else 0
    sums[block] = sum_of_lanes(added)
    square_rows(block, gains.reshape(gains.size), frequencies, squares)


@kernel
def step_gains(rows, times, tables, gains, first, second, decay, rates, sums, squares):
    """Adam's step of gains [M, 2, K] with the gradient that ``write_gains`` would write; float32.

    Args:
        rows, times, tables: of ``write_gains``.
        gains, first, second: the gains and their moments.
        decay: weight decay of each frequency, as often as it takes to be whole vectors.
        rates: [5], a row of what ``adam.step`` takes.
        sums: out [blocks of BLOCK rows]: sums after the step.
        squares: out [blocks, K], sums of squares after the step, as ``adam.square_columns`` finds them.
    """
    parallel_for(
        _step_block, sums.shape[0],
        (rows, times, tables, gains, first, second, decay, rates, sums, squares),
    )  # fmt: skip
