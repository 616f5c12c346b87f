"""One heat source that heats all surfaces of a scene: its course over time, from how their temperatures went.

A lamp, a heating or a burner is switched on and off once for all that it warms. A surface answers in a few exponentials, as
the conduction into its depth has it (Carslaw and Jaeger, Conduction of Heat in Solids, 3.11), whatever the course is:

    x(t) = Σ_j h_j e^{-r_j t} + g_j r_j ∫ e^{-r_j (t-τ)} s(τ) dτ

With rates r_j that surfaces share, h and g of a surface and s of the scene, both are least squares given the other.

**Convention:** time counts in spans of the record, 0 at its first image and 1 at its last; values are above the surroundings.
"""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.physics.responses import ResponseTable

# Per span. They tell as much as four and five do (misfits of 0.50, 0.41 and 0.38 squared errors on slabs under a lamp), and hold
# a gap in the record better (0.37, 0.39 and 0.49 °C).
RATES = (2.0, 8.0, 32.0)
MOMENTS = 64  # of the record, between which a source's power is linear
# Weight of the mean squared second derivative of the course, times the fourth power of the images' spacing, as of a spline
# through them: it decides where none was taken. Where 16 to 31 images were, a course that bends as those of 63 may is as rough
# as they are few, and foresees images that it was not fitted to by 1.5 to 2 times as much.
BEND = 1.5e-3
ROUNDS = (
    24  # in which numbers of surfaces and the course take turns; from the 15th on it moves by less than a hundredth
)
RIDGE = 1e-7  # of a surface's own numbers, in units of what the values say on average of one of them
SINGLE = torch.logspace(-1, 2, 25, dtype=torch.float64)  # rates of which each surface takes one at first


def response_table(rates: Tensor, moments: int) -> ResponseTable:
    """Settled responses [R, K] of rates [R], float64 per span, to sources that are 1 at one of K moments and 0 at the others."""
    knots = torch.linspace(0, 1, moments, dtype=torch.float64)
    return ResponseTable(knots, torch.eye(moments, dtype=torch.float64), rates.log())


def response(course: Tensor, spans: Tensor, rates: Tensor) -> tuple[Tensor, Tensor]:
    """What surfaces make of their start and of a source at spans [F]: decays and settled responses [F, R] of rates [R], float64
    per span, to a course of power [K]."""
    table = response_table(rates, len(course))
    driven = torch.stack([table.exact(float(at)) @ course for at in spans])
    return torch.exp(-spans[:, None] * rates), driven


def common_course(
    values: Tensor,
    weights: Tensor,
    spans: Tensor,
    rates: Tensor | None = None,
    moments: int = MOMENTS,
    smooth: float = BEND,
    start: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """The course [K] of a common source, of at most 1 in size, and what it leaves of the values [P, F], those not seen being 0.

    Without a course to start from, one rate for each surface finds it where sums of several, that can be anything at first,
    would not.

    Args:
        values: [P, F] float64.
        weights: [P, F] of their squares; 0 where a surface was not seen.
        spans: [F] float64, when.
        rates: [R] float64; None: ``RATES``.
        moments: K.
        smooth: as ``BEND``, relative to what values say on average of a moment.
        start: [K] course that was found in much the same values.
    """
    rates = torch.tensor(RATES, dtype=torch.float64) if rates is None else rates
    values = torch.where(weights > 0, values, 0.0)
    seen = max(int((weights > 0).any(0).sum()), 2)
    bends = torch.eye(moments, dtype=torch.float64).diff(n=2, dim=0) * (moments - 1) ** 2
    bent = smooth / (seen - 1) ** 4 * bends.mT @ bends
    course = torch.ones(moments, dtype=torch.float64) if start is None else start
    stages = ((SINGLE, _of_one_rate), (rates, _of_all_rates))
    for tried, explain in stages if start is None else stages[1:]:
        table = response_table(tried, moments)
        unit = torch.stack([table.exact(float(at)) for at in spans])
        decays = torch.exp(-spans[:, None] * tried)
        for _ in range(ROUNDS):
            kept, gains = explain(values, weights, decays, unit @ course)
            course = _course(values - kept, weights, gains, unit, bent)
    driven = unit @ course
    kept, gains = explain(values, weights, decays, driven)
    return course, values - kept - gains @ driven.T


def _course(values: Tensor, weights: Tensor, gains: Tensor, unit: Tensor, bent: Tensor) -> Tensor:
    """The course [K] that explains values [P, F] best, given gains [P, R] at rates and what moments become there [F, R, K]."""
    squares = torch.stack([(gains * weight[:, None]).T @ gains for weight in weights.T])  # [F, R, R]
    normal = (squares @ unit).flatten(0, 1).T @ unit.flatten(0, 1)
    wanted = unit.flatten(0, 1).T @ ((weights * values).T @ gains).flatten()
    level = normal.diagonal().mean().clamp_min(1e-300)
    ridge = 1e-12 * torch.eye(len(bent), dtype=bent.dtype)
    course = torch.linalg.solve(normal + level * (bent + ridge), wanted)
    return course / course.abs().max().clamp_min(1e-300)


def _of_one_rate(values: Tensor, weights: Tensor, decays: Tensor, driven: Tensor) -> tuple[Tensor, Tensor]:
    """What is left of the start [P, F], and gains [P, R] of surfaces, each at the one rate that fits it best."""
    tried = [
        least_squares(values, weights, torch.stack([decays[:, rate], driven[:, rate]], 1))
        for rate in range(decays.shape[1])
    ]
    best = torch.stack([explained for _, explained in tried]).argmax(0)
    own = torch.stack([numbers for numbers, _ in tried])[best, torch.arange(len(values))]
    gains = own.new_zeros(len(values), decays.shape[1]).scatter(1, best[:, None], own[:, 1:])
    return own[:, :1] * decays.T[best], gains


def _of_all_rates(values: Tensor, weights: Tensor, decays: Tensor, driven: Tensor) -> tuple[Tensor, Tensor]:
    """As ``_of_one_rate``, each surface at all of the rates."""
    numbers, _ = least_squares(values, weights, torch.cat([decays, driven], 1))
    count = decays.shape[1]
    return numbers[:, :count] @ decays.T, numbers[:, count:]


def least_squares(values: Tensor, weights: Tensor, basis: Tensor, ridge: float = RIDGE) -> tuple[Tensor, Tensor]:
    """Numbers [P, m] of each surface for a basis [F, m] of its values [P, F], and the squares [P] that they explain."""
    normal = torch.einsum("pf,fm,fn->pmn", weights, basis, basis)
    wanted = torch.einsum("pf,fm->pm", weights * values, basis)
    level = normal.diagonal(dim1=1, dim2=2).mean(1).clamp_min(1e-300)
    eye = torch.eye(basis.shape[1], dtype=basis.dtype)
    numbers = torch.linalg.solve(normal + ridge * level[:, None, None] * eye, wanted)
    return numbers, (numbers * wanted).sum(1)
