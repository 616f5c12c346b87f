"""What a few noisy looks at a body tell of how it relaxes, before anything is trained."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.same_bits import mean

STAYS, RELAXES = 0.1, 4.0  # per span of the record: the time constant is ten records, or a quarter of one
TRIED = (STAYS, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0)
ALIKE = 1.05  # the slowest rate whose misfit is within this factor of the least explains as much
LEAST_LOOKS = 4
REWEIGHTED = 3  # times: least squares become least absolute deviations, which stand what was hidden in some views


def first_rates(values: Tensor, spans: Tensor, ambient: Tensor) -> Tensor:
    """Rates per span [N] to start bodies with: RELAXES where T(t) = T_a + (T_0 - T_a) exp(-r t) shows, else STAYS.

    A body that shows no change, or that changes as none relaxes, so starts as one that keeps its temperature: a source that
    is learned beside need not make up, with harmonics that nothing holds between the images, for a decay that never was.

    Args:
        values: [N, F] what was seen, in any unit of temperature; NaN where a body was not seen.
        spans: [F] when, in spans of the record from its first moment.
        ambient: [] temperature of the surroundings, in that unit.
    """
    seen = ~values.isnan()
    above = torch.where(seen, values - ambient, 0.0)
    floor = 1e-4 * mean(above.abs()).clamp_min(1e-12)
    misfits = []
    for rate in TRIED:
        kept = torch.exp(-rate * spans).to(values)
        weights = seen.to(values)
        for _ in range(REWEIGHTED):
            start = (weights * above * kept).sum(1) / (weights * kept * kept).sum(1).clamp_min(1e-30)
            off = (above - start[:, None] * kept).abs()
            weights = seen / (off + floor)
        misfits.append((seen * off).sum(1))
    stays, least = misfits[0], torch.stack(misfits).amin(0)
    relaxes = (seen.sum(1) >= LEAST_LOOKS) & (stays > ALIKE * least + floor)
    return torch.where(relaxes, RELAXES, STAYS).to(values)


def first_numbers(values: Tensor, courses: Tensor, levels: Tensor) -> Tensor:
    """Numbers [N, M] of bodies for courses over time that all have in common, from what was seen of each.

    They start from those few that make a constant, at the median of what was seen: a look or two tell nothing of a course.

    Args:
        values: [N, F] what was seen above the surroundings; NaN where a body was not seen.
        courses: [F, M] at these moments, uncorrelated and each with a root mean square of about 1.
        levels: [N] median of what was seen of each.
    """
    usual = courses.mean(0)
    start = levels[:, None] * (usual / usual.square().sum().clamp_min(1e-12))
    seen = ~values.isnan()
    left = torch.where(seen, values - start @ courses.T, 0.0)
    floor = 1e-2 * mean(left.abs()).clamp_min(1e-12)
    eye = torch.eye(courses.shape[1], dtype=values.dtype)
    numbers, weights = torch.zeros_like(start), seen.to(values)
    for _ in range(REWEIGHTED):
        normal = torch.einsum("nf,fm,fk->nmk", weights, courses, courses)
        prior = weights.sum(1) / seen.sum(1).clamp_min(1) + 1e-12  # as much as one look says
        wanted = torch.einsum("nf,fm->nm", weights * left, courses)
        numbers = torch.linalg.solve(normal + prior[:, None, None] * eye, wanted)
        weights = seen / ((left - numbers @ courses.T).abs() + floor)
    return start + numbers
