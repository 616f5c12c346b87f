"""Spherical harmonics of degree 1 to 3 for the Gaussians in view, forward and backward.

The plain-torch twin is heatsplat.geometry.spherical_harmonics.evaluate, which says what the conventions are. Lanes are
sixteen Gaussians in the polynomials of the direction; sums over coefficients go row by row where they live (turning
rows into lanes costs more than it saves). Every Gaussian is computed and written by one thread: the number of threads
changes no bit.
"""

from __future__ import annotations

import numpy as np

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.scheduling import parallel_for
from heatsplat.kernels.simd import LANES, absolute, load, maximum, select, splat, sqrt, store

BLOCK = 512  # Gaussians per parallel task: enough to hide its start, few enough to share 10 k of them
SHORTEST = np.float32(1e-37)  # directions below this have length zero, so that 1 / length is finite

_f = np.float32
_ZERO, _ONE = _f(0.0), _f(1.0)
_A0 = _f(0.28209479177387814)
_A1 = _f(0.4886025119029199)
_A2, _B2, _C2 = _f(1.0925484305920792), _f(0.31539156525252005), _f(0.5462742152960396)
_A3, _B3, _C3 = _f(0.5900435899266435), _f(2.890611442640554), _f(0.4570457994644658)
_D3, _E3 = _f(0.3731763325901154), _f(1.445305721320277)


@inline
def _directions(means, ids, start, stop, center, places):
    """Unit vectors from ``center`` to the means of ``ids[start:stop]``, and 1 / length; zeros for no length."""
    for lane in range(stop - start):
        row = ids[start + lane]
        for axis in range(3):
            places[axis * LANES + lane] = means[row, axis] - center[axis]
    x, y, z = load(places, 0), load(places, LANES), load(places, 2 * LANES)
    largest = maximum(maximum(absolute(x), absolute(y)), absolute(z))
    some = largest > SHORTEST
    shrink = select(some, _ONE / largest, splat(_ZERO))
    x, y, z = x * shrink, y * shrink, z * shrink
    inverse = select(some, _ONE / sqrt(x * x + y * y + z * z), splat(_ZERO))
    return x * inverse, y * inverse, z * inverse, shrink * inverse


@inline
def _fill_basis(x, y, z, degree, basis):
    """Writes the harmonics after the constant one, [(degree + 1)² - 1, 16], of unit vectors."""
    store(basis, 0, -_A1 * y)
    store(basis, LANES, _A1 * z)
    store(basis, 2 * LANES, -_A1 * x)
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        store(basis, 3 * LANES, _A2 * x * y)
        store(basis, 4 * LANES, -_A2 * y * z)
        store(basis, 5 * LANES, _B2 * (_f(2) * zz - xx - yy))
        store(basis, 6 * LANES, -_A2 * x * z)
        store(basis, 7 * LANES, _C2 * (xx - yy))
        if degree >= 3:
            store(basis, 8 * LANES, -_A3 * y * (_f(3) * xx - yy))
            store(basis, 9 * LANES, _B3 * x * y * z)
            store(basis, 10 * LANES, -_C3 * y * (_f(4) * zz - xx - yy))
            store(basis, 11 * LANES, _D3 * z * (_f(2) * zz - _f(3) * xx - _f(3) * yy))
            store(basis, 12 * LANES, -_C3 * x * (_f(4) * zz - xx - yy))
            store(basis, 13 * LANES, _E3 * z * (xx - yy))
            store(basis, 14 * LANES, -_A3 * x * (xx - _f(3) * yy))


@inline
def _slope(x, y, z, degree, weights):
    """Gradient with respect to x, y and z of the harmonics' sum with ``weights`` [15, 16]."""
    slope_x = -_A1 * load(weights, 2 * LANES)
    slope_y = -_A1 * load(weights, 0)
    slope_z = _A1 * load(weights, LANES)
    if degree >= 2:
        w3, w4, w5 = load(weights, 3 * LANES), load(weights, 4 * LANES), load(weights, 5 * LANES)
        w6, w7 = load(weights, 6 * LANES), load(weights, 7 * LANES)
        slope_x = slope_x + _A2 * (w3 * y - w6 * z) + _f(2) * x * (_C2 * w7 - _B2 * w5)
        slope_y = slope_y + _A2 * (w3 * x - w4 * z) - _f(2) * y * (_C2 * w7 + _B2 * w5)
        slope_z = slope_z + _f(4) * _B2 * w5 * z - _A2 * (w4 * y + w6 * x)
        if degree >= 3:
            w8, w9, w10 = load(weights, 8 * LANES), load(weights, 9 * LANES), load(weights, 10 * LANES)
            w11, w12, w13 = load(weights, 11 * LANES), load(weights, 12 * LANES), load(weights, 13 * LANES)
            w14 = load(weights, 14 * LANES)
            xx, yy, zz = x * x, y * y, z * z
            slope_x = slope_x - _A3 * (_f(6) * x * y * w8 + _f(3) * (xx - yy) * w14) + _B3 * y * z * w9
            slope_x = slope_x + _C3 * (_f(2) * x * y * w10 - (_f(4) * zz - _f(3) * xx - yy) * w12)
            slope_x = slope_x + x * z * (_f(2) * _E3 * w13 - _f(6) * _D3 * w11)
            slope_y = slope_y - _A3 * (_f(3) * (xx - yy) * w8 - _f(6) * x * y * w14) + _B3 * x * z * w9
            slope_y = slope_y - _C3 * ((_f(4) * zz - xx - _f(3) * yy) * w10 - _f(2) * x * y * w12)
            slope_y = slope_y - y * z * (_f(2) * _E3 * w13 + _f(6) * _D3 * w11)
            slope_z = slope_z + _B3 * x * y * w9 - _f(8) * _C3 * z * (y * w10 + x * w12)
            slope_z = slope_z + _f(3) * _D3 * (_f(2) * zz - xx - yy) * w11 + _E3 * (xx - yy) * w13
    return slope_x, slope_y, slope_z


@inline
def _forward_block(block, constant, rest, means, center, ids, degree, values):
    """``forward`` of BLOCK Gaussians."""
    count, channels = values.shape
    bands = (degree + 1) ** 2 - 1
    places = np.zeros(3 * LANES, np.float32)
    basis = np.empty((15, LANES), np.float32)
    for start in range(block * BLOCK, min(count, (block + 1) * BLOCK), LANES):
        stop = min(start + LANES, count)
        x, y, z, _ = _directions(means, ids, start, stop, center, places)
        _fill_basis(x, y, z, degree, basis)
        for lane in range(stop - start):
            row = ids[start + lane]
            for c in range(channels):
                value = _A0 * constant[row, 0, c]
                for b in range(bands):
                    value += basis[b, lane] * rest[row, b, c]
                values[start + lane, c] = value


@kernel
def forward(constant, rest, means, center, ids, degree, values):
    """Fills ``values`` [n, C] with the sums of harmonics.

    Args:
        constant: [N, 1, C] coefficients of the constant harmonic.
        rest: [N, B - 1, C] those of the further ones, at least (degree + 1)² - 1 of them.
        means: [N, 3] positions.
        center: [3] position of the camera.
        ids: [n] int64, the Gaussians to evaluate.
        degree: 1 to 3.
        values: [n, C] output.
    """
    parallel_for(
        _forward_block, (values.shape[0] + BLOCK - 1) // BLOCK, (constant, rest, means, center, ids, degree, values)
    )


@inline
def _backward_block(block, rest, means, center, ids, degree, v_values, v_constant, v_rest, v_means):
    """``backward`` of BLOCK Gaussians."""
    count, channels = v_values.shape
    bands = (degree + 1) ** 2 - 1
    places = np.zeros(3 * LANES, np.float32)
    basis = np.empty((15, LANES), np.float32)
    weights = np.zeros((15, LANES), np.float32)  # gradient of each harmonic's value
    slopes = np.empty((3, LANES), np.float32)
    for start in range(block * BLOCK, min(count, (block + 1) * BLOCK), LANES):
        stop = min(start + LANES, count)
        x, y, z, inverse = _directions(means, ids, start, stop, center, places)
        _fill_basis(x, y, z, degree, basis)
        for lane in range(stop - start):
            row = ids[start + lane]
            for c in range(channels):
                v_constant[row, 0, c] = _A0 * v_values[start + lane, c]
            for b in range(bands):
                weight = _ZERO
                for c in range(channels):
                    v_rest[row, b, c] = basis[b, lane] * v_values[start + lane, c]
                    weight += rest[row, b, c] * v_values[start + lane, c]
                weights[b, lane] = weight
            for b in range(bands, v_rest.shape[1]):
                for c in range(channels):
                    v_rest[row, b, c] = _ZERO
        slope_x, slope_y, slope_z = _slope(x, y, z, degree, weights)
        along = x * slope_x + y * slope_y + z * slope_z  # the length of a direction does not matter
        store(slopes, 0, (slope_x - along * x) * inverse)
        store(slopes, LANES, (slope_y - along * y) * inverse)
        store(slopes, 2 * LANES, (slope_z - along * z) * inverse)
        for lane in range(stop - start):
            for axis in range(3):
                v_means[ids[start + lane], axis] = slopes[axis, lane]


@kernel
def backward(rest, means, center, ids, degree, v_values, v_constant, v_rest, v_means):
    """Writes the rows ``ids`` of the gradients, zeros for harmonics above ``degree``; ids must not repeat.

    Args:
        rest, means, center, ids, degree: as in ``forward``.
        v_values: [n, C] gradient of the values.
        v_constant, v_rest, v_means: [N, 1, C], [N, B - 1, C] and [N, 3] outputs.
    """
    parallel_for(
        _backward_block,
        (v_values.shape[0] + BLOCK - 1) // BLOCK,
        (rest, means, center, ids, degree, v_values, v_constant, v_rest, v_means),
    )
