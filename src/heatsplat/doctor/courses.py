"""What is left of points' values over time beside their own smooth courses: what surfaces do that warm or cool by themselves
or with the weather."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.doctor.base import Material

RATES = (1.0, 4.0, 16.0)  # of exponentials over the record, in its inverse spans; sums of them follow what settles
ENOUGH = 2.0  # observations of a point for each of the numbers of its course
RIDGE = 1e-9
RANK = 1e-9  # of the largest direction that courses span, below which one is rounding


def beside_courses(values: Tensor, weights: Tensor, material: Material) -> tuple[Tensor, Tensor]:
    """Values [P, F] without each point's level and course, and weights that leave out points that are seen too seldom.

    A course is a sum of exponentials, and of answers to recorded weather where there is a record. Without times a point has a
    level only.
    """
    columns = [torch.ones(values.shape[1], dtype=values.dtype)]
    if material.chosen_times_s is not None:
        times = material.chosen_times_s.to(values.dtype)
        share = (times - times.min()) / (times.max() - times.min()).clamp_min(1e-9)
        columns += [torch.exp(-rate * share) for rate in RATES]
    if material.answers is not None:
        columns += [answer for answer in material.answers.to(values.dtype).T if bool(answer.any())]
    directions, sizes, _ = torch.linalg.svd(torch.stack(columns, 1), full_matrices=False)
    basis = directions[:, sizes > RANK * sizes[0]]  # few moments tell few courses apart
    weights = weights * ((weights > 0).sum(1) >= ENOUGH * basis.shape[1])[:, None]
    inner = torch.einsum("pf,fi,fj->pij", weights, basis, basis)
    scale = inner.diagonal(dim1=1, dim2=2).mean(1).clamp_min(1e-30)
    inner = inner + RIDGE * scale[:, None, None] * torch.eye(basis.shape[1], dtype=values.dtype)
    numbers = torch.linalg.solve(inner, torch.einsum("pf,fi,pf->pi", weights, basis, values))
    return values - numbers @ basis.T, weights
