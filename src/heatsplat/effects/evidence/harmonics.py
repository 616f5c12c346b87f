"""How many harmonics say what drives a scene."""

from __future__ import annotations

import math

import torch

from heatsplat.effects.evidence.fits import Fits, Model
from heatsplat.effects.observations import Observations
from heatsplat.physics.frequencies import default_tau_min, frequency_grid

COUNTS = (1, 2, 3, 4, 6, 8, 12, 16, 24)


def needed(fit: Fits, model: Model, obs: Observations) -> int:
    """K for which the criterion is least when the courses that points share are written as K harmonics and a decay.

    The grid of frequencies is that of the thermal model, whose response to a harmonic after its start is that harmonic
    and a decay.
    """
    recorded = torch.tensor([t for t in obs.scene.train.times_s if t is not None], dtype=torch.float64)
    courses = fit.common_courses(max(model.courses, 1))
    frames, count = courses.shape
    passed = obs.times_s - obs.times_s.min()
    span = float(passed.max())
    decays = torch.exp(-passed[:, None] / span * torch.tensor([0.7, 3.0, 12.0], dtype=torch.float64))
    used = (fit.weights > 0).sum(0).double()
    # A course is known as well as the mean over the points that show it; the noise of one point is the criterion's own.
    best, least = 1, math.inf
    for harmonics in COUNTS:
        omega = frequency_grid(recorded, harmonics, default_tau_min(recorded), math.sqrt(0.5))
        phases = passed[:, None] * omega
        basis = torch.cat([torch.ones(frames, 1, dtype=torch.float64), decays, phases.cos(), phases.sin()], 1)
        if basis.shape[1] > frames - 2:
            break
        left = courses - basis @ torch.linalg.lstsq(basis, courses).solution
        variance = max(float((left**2).sum()) / (count * (frames - basis.shape[1])), 1e-12)
        criterion = frames * count * math.log(variance) + 2 * len(omega) * count * math.log(float(used.mean()))
        if criterion < least:
            best, least = harmonics, criterion
    return best
