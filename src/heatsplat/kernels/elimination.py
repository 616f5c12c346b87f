"""Sums of weighted least squares for rows of which few entries are not zero, where numbers of single points are eliminated.

heatsplat.effects.joint.least_squares says what is solved and drives this kernel; its plain-torch twin stands in the tests.
All is float64, and every sum has the order of points and images.
"""

from __future__ import annotations

import math

import numpy as np

from heatsplat.kernels.compilation import kernel

_LEAST = 1e-300


@kernel
def sum_products(basis, weights, slots, values, within, said, inner):
    """Adds inner products of columns and of points' own bases, whose members have length 1 over the images of their point.

    Args:
        basis: [P, F, k] of each point, or [1, F, k] of all.
        weights: [P, F] of squares; rows of weight 0 are passed over.
        slots: [P, F, m] int64 columns in which a row has entries; one may come twice.
        values: [P, F, m] those entries.
        within: [c, c] to which half of the products of columns is added: it and its transpose are all of them.
        said: [P, c, k] to which products of columns with the own bases are added.
        inner: [P, k, k] to which products of the own bases are added, below the diagonal and on it.
    """
    points, frames, entries = slots.shape
    members = basis.shape[2]
    unit, own = np.empty(members), np.empty(members)
    for p in range(points):
        q = p if basis.shape[0] > 1 else 0
        unit[:] = 0.0
        for f in range(frames):
            weight = weights[p, f]
            if weight > 0.0:
                for j in range(members):
                    unit[j] += weight * basis[q, f, j] * basis[q, f, j]
        for j in range(members):
            unit[j] = 1.0 / max(math.sqrt(unit[j]), _LEAST)
        for f in range(frames):
            weight = weights[p, f]
            if not weight > 0.0:
                continue
            root = math.sqrt(weight)
            for j in range(members):
                own[j] = root * basis[q, f, j] * unit[j]
                for i in range(j + 1):
                    inner[p, j, i] += own[j] * own[i]
            for a in range(entries):
                value, column = root * values[p, f, a], slots[p, f, a]
                if value == 0.0:
                    continue
                for j in range(members):
                    said[p, column, j] += own[j] * value
                within[column, column] += 0.5 * value * value
                for b in range(a):
                    within[column, slots[p, f, b]] += value * (root * values[p, f, b])
