"""Temperatures of the Gaussians in view: the closed form of relaxation.py for rows of per-Gaussian tensors."""

from __future__ import annotations

from torch import Tensor

from heatsplat.physics.relaxation import temperature


def visible_temperature(
    time: Tensor,
    ambient: Tensor,
    initial: Tensor,
    rate: Tensor,
    omega: Tensor,
    gains: Tensor | None = None,
    inverse_capacity: Tensor | None = None,
    ids: Tensor | None = None,
) -> Tensor:
    """Temperature at a time of the Gaussians ``ids``, [n]; only their rows are read.

    **Convention:** units as in ``relaxation.temperature``.

    Args:
        time: [] float64.
        ambient: [].
        initial, rate: [N].
        omega: [K] float64.
        gains: [N, 2, K] strengths of the sources sin ωt and cos ωt, one row of memory per Gaussian; None is no source.
        inverse_capacity: [N] multiplies the sources of a Gaussian; None is 1.
        ids: [n] int64 rows, each at most once; None is all of them.
    """
    return _reference(time, ambient, initial, rate, omega, gains, inverse_capacity, ids)


def _reference(time, ambient, initial, rate, omega, gains, inverse_capacity, ids) -> Tensor:
    """The plain form and the oracle of the kernel."""
    rows = [None if x is None else x if ids is None else x.index_select(0, ids) for x in (initial, rate, gains)]
    initial, rate, gains = rows
    if gains is None:
        gains, omega = rate.new_zeros(rate.shape[0], 2, 0), omega[:0]
    if inverse_capacity is not None:
        scale = inverse_capacity if ids is None else inverse_capacity.index_select(0, ids)
        gains = gains * scale[:, None, None]
    return temperature(time, ambient, initial, rate, omega, gains[:, 0], gains[:, 1])
