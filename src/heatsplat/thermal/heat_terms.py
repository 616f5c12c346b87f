"""The penalties by which ThermoGS ties a predicted temperature to time, to a balance of heat and to a table (Eq. 10-11).

**Convention:** temperatures in units of the network's range (0 its lower, 1 its upper bound), so that differences keep
the digits that kelvin in float32 would lose; rates in such units per second, counted in the range's span. All are means
over Gaussians [n] and of order one when prediction and balance have nothing to do with each other.
"""

from __future__ import annotations

from torch import Tensor

from heatsplat.same_bits import mean, total
from heatsplat.thermal.land_cover import ATTRIBUTES

SCALES = {"emissivity": 1.0, "absorptivity": 1.0, "convection": 10.0, "capacity": 2.5e6}  # what counts as one


def change(now: Tensor, later: Tensor) -> Tensor:
    """L_smooth, the mean |T(t + Δ) - T(t)| (Eq. 10 with one interval)."""
    return mean((later - now).abs())


def difference_quotient(now: Tensor, later: Tensor, rates: Tensor, interval_s: float, scale_s: float) -> Tensor:
    """L_pinn, the mean |(T(t + Δ) - T(t)) / Δ - dT/dt|, per range in ``scale_s``.

    Args:
        rates: dT/dt of the balance over the interval.
        interval_s: Δ, of either sign.
        scale_s: seconds in which a change by the whole range counts as one.
    """
    return mean(((later - now) / interval_s - rates).abs()) * scale_s


def integration(now: Tensor, later: Tensor, rates: Tensor, interval_s: float) -> Tensor:
    """L_ode, the mean |T(t) + Δ dT/dt - T(t + Δ)| with the rate at the middle of the interval."""
    return mean((now + interval_s * rates - later).abs())


def to_reference(body: dict[str, Tensor], reference: Tensor) -> Tensor:
    """L_physical, the mean distance of attributes to their reference, each in its own ``SCALES``.

    Args:
        body: attributes by name, each [n].
        reference: [n, 4] in the order of ``land_cover.ATTRIBUTES``; NaN where there is none, which does not count.
    """
    known = ~reference[:, 0].isnan()
    apart = sum(
        total(((body[name] - reference[:, column]).abs() / SCALES[name]).masked_fill(~known, 0.0))
        for column, name in enumerate(ATTRIBUTES)
    )
    return apart / (len(ATTRIBUTES) * known.sum().clamp(min=1))
