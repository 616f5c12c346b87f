"""Temperatures of the Gaussians in view and their gradients, as heatsplat.kernels.relaxation has them, for CUDA.

A program takes BLOCK Gaussians and all their frequencies at once. Formulas and the table of frequencies are those of the twin,
whose module says what the symbols mean; ``backward`` finds the responses again, for they are cheaper than their memory.
"""

from __future__ import annotations

import math

import triton
import triton.language as tl

from heatsplat.kernels import relaxation as twin

BLOCK = 32  # Gaussians of a program

_ROWS = {name: tl.constexpr(getattr(twin, name)) for name in (
    "OMEGA", "OMEGA_SQUARED", "OMEGA_COSC", "OMEGA_SQUARED_SINC", "NEAR", "FAR", "X", "SINC2", "COSC1", "COSC3",
)}  # fmt: skip
OMEGA, OMEGA_SQUARED, OMEGA_COSC, OMEGA_SQUARED_SINC, NEAR, FAR, X, SINC2, COSC1, COSC3 = _ROWS.values()

# Rows of what ``forward`` leaves for ``backward``.
BY_RATE, BY_INITIAL, BY_AMBIENT, BY_SCALE, USED_RATE = (tl.constexpr(k) for k in range(5))
SLOPES = 5

_LARGEST_RATE = tl.constexpr(1e18)  # its square still fits
_TERMS = tl.constexpr(12)  # of θ2 for y <= 1: the next is below 1e-12


@triton.jit
def _functions(y):
    """φ, the offset in sinc - φ, e^{-y}, χ, θ, θ2 and χ2 of y = at."""
    small = y < 1.0
    near, far = tl.minimum(y, 1.0), tl.maximum(y, 1.0)
    theta2, term = tl.zeros_like(y), tl.full(y.shape, 1.0 / 6.0, y.dtype)
    for j in tl.static_range(_TERMS):
        theta2 += term
        term *= -near / (j + 4)
    theta = 0.5 - near * theta2
    phi_near = 1.0 - near * theta
    fall_far = tl.exp(-far)
    phi_far = (1.0 - fall_far) / far
    phi = tl.where(small, phi_near, phi_far)
    offset = tl.where(small, -(near * theta), phi_far)
    fall = tl.where(small, 1.0 - near * phi_near, fall_far)
    chi = tl.where(small, phi_near - theta, (phi_far - fall_far) / far)
    return phi, offset, fall, chi, theta, theta2, 0.5 - (1.0 + near) * theta2


@triton.jit
def _responses(table, k, known, width, a, phi, offset, small):
    """Responses to sin and to cos over time, [BLOCK, WIDTH], and 1/(a² + ω²); a, φ, offset and small are [BLOCK, 1]."""
    omega = tl.load(table + OMEGA * width + k, mask=known, other=1.0)[None, :]
    squared = tl.load(table + OMEGA_SQUARED * width + k, mask=known, other=1.0)[None, :]
    damped = tl.load(table + OMEGA_COSC * width + k, mask=known, other=0.0)[None, :]
    still = tl.load(table + OMEGA_SQUARED_SINC * width + k, mask=known, other=0.0)[None, :]
    near = tl.load(table + NEAR * width + k, mask=known, other=0.0)[None, :]
    far = tl.load(table + FAR * width + k, mask=known, other=0.0)[None, :]
    inverse = 1.0 / (squared + a * a)
    sine = omega * (a * (tl.where(small, near, far) - offset) + damped)
    cosine = a * (a * phi - damped) + still
    return sine * inverse, cosine * inverse, inverse


@triton.jit
def forward(
    rate, initial, ambient, gains, places, scale, ids, table, values, slopes, count, frequencies, width, time, limit, low,
    high, BOUNDED: tl.constexpr, HEATED: tl.constexpr, PLACED: tl.constexpr, SCALED: tl.constexpr, SLOPING: tl.constexpr,
    BLOCK: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Fills ``values`` [n] with the temperatures of the Gaussians ``ids``, and ``slopes`` [SLOPES, n] where SLOPING.

    Args:
        rate, initial, gains, places, scale, ids, time, limit, table: as the twin's, ambient is read from memory.
        count, frequencies, width: n, K and the padded K of the table.
        low, high: where BOUNDED, ``rate`` holds logarithms, which are taken within them.
        HEATED, PLACED, SCALED: whether there are gains, places and scales.
        WIDTH: a power of two, at least K.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    row = tl.load(ids + i, mask=inside, other=0)
    given = tl.load(rate + row, mask=inside, other=0.0)
    first = tl.load(initial + row, mask=inside, other=0.0)
    outer = tl.load(ambient)
    if BOUNDED:
        a = tl.exp(tl.minimum(tl.maximum(given, low), high))
        free = tl.where((given >= low) & (given <= high) & (a <= limit), a, 0.0)
    else:
        a = given
        free = tl.where(given <= limit, 1.0, 0.0)
    a = tl.minimum(tl.minimum(a, limit), _LARGEST_RATE)
    y = a * time
    small = y < 1.0
    phi, offset, fall, chi, theta, theta2, chi2 = _functions(y)
    above = first - outer
    # Each side from its own end, so that time 0 gives the initial temperature exactly and late times the ambient.
    value = tl.where(small, first - above * (y * phi), outer + above * fall)
    source, slope = tl.zeros_like(y), tl.zeros_like(y)
    if HEATED:
        place = row
        if PLACED:
            place = tl.load(places + row, mask=inside, other=-1)
        k = tl.arange(0, WIDTH)
        known = k < frequencies
        wanted = (inside & (place >= 0))[:, None] & known[None, :]
        at = gains + place[:, None] * (2 * frequencies) + k[None, :]
        sin_gain = tl.load(at, mask=wanted, other=0.0)
        cos_gain = tl.load(at + frequencies, mask=wanted, other=0.0)
        sine, cosine, inverse = _responses(
            table, k, known, width, a[:, None], phi[:, None], offset[:, None], small[:, None]
        )
        source = tl.sum(sin_gain * sine + cos_gain * cosine, 1)
        if SLOPING:
            omega = tl.load(table + OMEGA * width + k, mask=known, other=1.0)[None, :]
            squared = tl.load(table + OMEGA_SQUARED * width + k, mask=known, other=1.0)[None, :]
            x = tl.load(table + X * width + k, mask=known, other=0.0)[None, :]
            sinc2 = tl.load(table + SINC2 * width + k, mask=known, other=0.0)[None, :]
            cosc1 = tl.load(table + COSC1 * width + k, mask=known, other=0.0)[None, :]
            cosc3 = tl.load(table + COSC3 * width + k, mask=known, other=0.0)[None, :]
            rates = a[:, None]
            rest = fall[:, None] - cosine
            far_sine, far_cosine = -(rates * sine + omega * rest) * inverse, (rates * rest - omega * sine) * inverse
            q, o = rates * rates * inverse, squared * inverse
            inner = (q - o) * (q * theta2[:, None] + o * sinc2) - q * chi2[:, None]
            inner += o * o * (cosc3 * (2.0 * y[:, None]))
            near_cosine = (q - o) * cosc1 + 2.0 * (o * sinc2 * y[:, None] - q * theta[:, None])
            near_cosine = near_cosine * o - q * chi[:, None]
            near_slope = tl.sum(sin_gain * (x * inner) + cos_gain * near_cosine, 1) * time
            slope = tl.where(small, near_slope, tl.sum(sin_gain * far_sine + cos_gain * far_cosine, 1))
    if SCALED:
        factor = tl.load(scale + row, mask=inside, other=0.0)
        if SLOPING:
            tl.store(slopes + BY_SCALE * count + i, time * source, mask=inside)
        source *= factor
        slope *= factor
    tl.store(values + i, value + time * source, mask=inside)
    if SLOPING:
        by_rate = time * slope - above * time * fall
        tl.store(slopes + BY_RATE * count + i, tl.where(free > 0.0, by_rate * free, 0.0), mask=inside)
        tl.store(slopes + BY_INITIAL * count + i, fall, mask=inside)
        tl.store(slopes + BY_AMBIENT * count + i, y * phi, mask=inside)
        tl.store(slopes + USED_RATE * count + i, a, mask=inside)


@triton.jit
def backward(
    slopes, v_values, places, scale, ids, table, v_rate, v_initial, v_ambient, v_scale, v_gains, count, frequencies, width,
    time, HEATED: tl.constexpr, PLACED: tl.constexpr, SCALED: tl.constexpr, BLOCK: tl.constexpr, WIDTH: tl.constexpr,
):  # fmt: skip
    """Writes the rows ``ids`` of the gradients; ids must not repeat. ``v_ambient`` [programs] gets a sum of each program."""
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    row = tl.load(ids + i, mask=inside, other=0)
    v = tl.load(v_values + i, mask=inside, other=0.0)
    tl.store(v_rate + row, v * tl.load(slopes + BY_RATE * count + i, mask=inside, other=0.0), mask=inside)
    tl.store(v_initial + row, v * tl.load(slopes + BY_INITIAL * count + i, mask=inside, other=0.0), mask=inside)
    tl.store(v_ambient + tl.program_id(0), tl.sum(v * tl.load(slopes + BY_AMBIENT * count + i, mask=inside, other=0.0)))
    pull = v * time
    if SCALED:
        tl.store(v_scale + row, v * tl.load(slopes + BY_SCALE * count + i, mask=inside, other=0.0), mask=inside)
        pull *= tl.load(scale + row, mask=inside, other=0.0)
    if HEATED:
        place = row
        if PLACED:
            place = tl.load(places + row, mask=inside, other=-1)
        a = tl.load(slopes + USED_RATE * count + i, mask=inside, other=0.0)
        y = a * time
        phi, offset, _fall, _chi, _theta, _theta2, _chi2 = _functions(y)
        k = tl.arange(0, WIDTH)
        known = k < frequencies
        sine, cosine, _inverse = _responses(
            table, k, known, width, a[:, None], phi[:, None], offset[:, None], (y < 1.0)[:, None]
        )
        wanted = (inside & (place >= 0))[:, None] & known[None, :]
        at = v_gains + place[:, None] * (2 * frequencies) + k[None, :]
        tl.store(at, sine * pull[:, None], mask=wanted)
        tl.store(at + frequencies, cosine * pull[:, None], mask=wanted)


def programs(count: int) -> tuple[int]:
    """How many programs ``count`` Gaussians take."""
    return (math.ceil(count / BLOCK),)
