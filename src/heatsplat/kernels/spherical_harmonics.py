"""Spherical harmonics of degree 0 to 3 for the Gaussians in view, forward and backward.

The plain-torch twin is heatsplat.geometry.spherical_harmonics.evaluate, which says what the conventions are. Here
coefficients stay where they live (no gathered copy), and a direction is found from a mean and the camera's centre.
Every Gaussian is computed and written by one thread, so results do not depend on the number of threads.
"""

from __future__ import annotations

import numpy as np
from numba import njit, prange

FAST = {"contract", "nsz", "arcp"}
BLOCK = 512  # Gaussians per parallel task: enough work to hide its start, few enough to balance 10 k of them


@njit(inline="always")
def _direction(x, y, z):
    """Unit vector and length of a vector; zeros for a vector of (almost) zero length."""
    zero, one = np.float32(0.0), np.float32(1.0)
    largest = max(abs(x), max(abs(y), abs(z)))
    if largest < np.float32(1e-37):  # so that 1 / length is finite
        return zero, zero, zero, zero
    x, y, z = x / largest, y / largest, z / largest
    length = np.sqrt(x * x + y * y + z * z)
    inverse = one / length
    return x * inverse, y * inverse, z * inverse, length * largest


@njit(inline="always")
def _fill_basis(x, y, z, degree, basis):
    """Harmonics 1 .. (degree + 1)² - 1 of a unit vector; ``basis[0]`` is the first after the constant."""
    f = np.float32
    basis[0] = f(-0.4886025119029199) * y
    basis[1] = f(0.4886025119029199) * z
    basis[2] = f(-0.4886025119029199) * x
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis[3] = f(1.0925484305920792) * x * y
        basis[4] = f(-1.0925484305920792) * y * z
        basis[5] = f(0.31539156525252005) * (f(2) * zz - xx - yy)
        basis[6] = f(-1.0925484305920792) * x * z
        basis[7] = f(0.5462742152960396) * (xx - yy)
        if degree >= 3:
            basis[8] = f(-0.5900435899266435) * y * (f(3) * xx - yy)
            basis[9] = f(2.890611442640554) * x * y * z
            basis[10] = f(-0.4570457994644658) * y * (f(4) * zz - xx - yy)
            basis[11] = f(0.3731763325901154) * z * (f(2) * zz - f(3) * xx - f(3) * yy)
            basis[12] = f(-0.4570457994644658) * x * (f(4) * zz - xx - yy)
            basis[13] = f(1.445305721320277) * z * (xx - yy)
            basis[14] = f(-0.5900435899266435) * x * (xx - f(3) * yy)


@njit(inline="always")
def _basis_gradient(x, y, z, degree, q):
    """Gradient of sum_b q_b basis_b with respect to the unit vector, its three components taken as independent."""
    f = np.float32
    gx = f(-0.4886025119029199) * q[2]
    gy = f(-0.4886025119029199) * q[0]
    gz = f(0.4886025119029199) * q[1]
    if degree >= 2:
        a, b, c = f(1.0925484305920792), f(0.31539156525252005), f(0.5462742152960396)
        gx += a * (q[3] * y - q[6] * z) + f(2) * x * (c * q[7] - b * q[5])
        gy += a * (q[3] * x - q[4] * z) - f(2) * y * (c * q[7] + b * q[5])
        gz += f(4) * b * q[5] * z - a * (q[4] * y + q[6] * x)
        if degree >= 3:
            xx, yy, zz = x * x, y * y, z * z
            d, e, h = f(-0.5900435899266435), f(2.890611442640554), f(-0.4570457994644658)
            k, m = f(0.3731763325901154), f(1.445305721320277)
            gx += d * (f(6) * x * y * q[8] + f(3) * (xx - yy) * q[14]) + e * y * z * q[9]
            gx += h * (f(-2) * x * y * q[10] + (f(4) * zz - f(3) * xx - yy) * q[12])
            gx += x * z * (f(-6) * k * q[11] + f(2) * m * q[13])
            gy += d * (f(3) * (xx - yy) * q[8] - f(6) * x * y * q[14]) + e * x * z * q[9]
            gy += h * ((f(4) * zz - xx - f(3) * yy) * q[10] - f(2) * x * y * q[12])
            gy -= y * z * (f(6) * k * q[11] + f(2) * m * q[13])
            gz += e * x * y * q[9] + f(8) * h * z * (y * q[10] + x * q[12])
            gz += f(3) * k * (f(2) * zz - xx - yy) * q[11] + m * (xx - yy) * q[13]
    return gx, gy, gz


@njit(parallel=True, cache=True, fastmath=FAST)
def forward(constant, rest, means, center, ids, degree, values):
    """Fills ``values`` [n, C] with the sums of harmonics.

    Args:
        constant: [N, C] coefficients of the constant harmonic.
        rest: [N, B - 1, C] those of the further ones, at least (degree + 1)² - 1 of them.
        means: [N, 3] positions.
        center: [3] position of the camera.
        ids: [n] int64, the Gaussians to evaluate.
        degree: 1 to 3.
        values: [n, C] output.
    """
    count, channels = values.shape
    bands = (degree + 1) ** 2 - 1
    for block in prange((count + BLOCK - 1) // BLOCK):
        basis = np.empty(15, np.float32)
        for i in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            row = ids[i]
            x, y, z, _ = _direction(means[row, 0] - center[0], means[row, 1] - center[1], means[row, 2] - center[2])
            _fill_basis(x, y, z, degree, basis)
            for c in range(channels):
                total = np.float32(0.28209479177387814) * constant[row, c]
                for b in range(bands):
                    total += basis[b] * rest[row, b, c]
                values[i, c] = total


@njit(parallel=True, cache=True, fastmath=FAST)
def backward(rest, means, center, ids, degree, v_values, v_constant, v_rest, v_means):
    """Writes the rows ``ids`` of the gradients, the bands above ``degree`` as zeros; ids must not repeat.

    Args:
        rest, means, center, ids, degree: as in ``forward``.
        v_values: [n, C] gradient of the values.
        v_constant, v_rest, v_means: [N, C], [N, B - 1, C] and [N, 3] outputs.
    """
    count, channels = v_values.shape
    bands = (degree + 1) ** 2 - 1
    for block in prange((count + BLOCK - 1) // BLOCK):
        basis = np.empty(15, np.float32)
        q = np.empty(15, np.float32)  # coefficients of the harmonics, weighted by the gradient and summed over channels
        for i in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            row = ids[i]
            x, y, z, length = _direction(
                means[row, 0] - center[0], means[row, 1] - center[1], means[row, 2] - center[2]
            )
            _fill_basis(x, y, z, degree, basis)
            for c in range(channels):
                v_constant[row, c] = np.float32(0.28209479177387814) * v_values[i, c]
            for b in range(bands):
                total = np.float32(0.0)
                for c in range(channels):
                    v_rest[row, b, c] = basis[b] * v_values[i, c]
                    total += rest[row, b, c] * v_values[i, c]
                q[b] = total
            for b in range(bands, v_rest.shape[1]):
                for c in range(channels):
                    v_rest[row, b, c] = np.float32(0.0)
            inverse = np.float32(1.0) / length if length > np.float32(0.0) else np.float32(0.0)
            gx, gy, gz = _basis_gradient(x, y, z, degree, q)
            radial = x * gx + y * gy + z * gz  # the length of the direction does not matter
            v_means[row, 0] = (gx - radial * x) * inverse
            v_means[row, 1] = (gy - radial * y) * inverse
            v_means[row, 2] = (gz - radial * z) * inverse
