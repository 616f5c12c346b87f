"""Tracks of points that are made up, for tests of the joint fit."""

import torch
from torch.nn import functional

from heatsplat.effects.catalogue import CATALOGUE
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.fit import fit_of
from heatsplat.effects.joint.model import Model
from heatsplat.effects.observations import Tracks

POINTS, FRAMES, NOISE = 60, 30, 0.01
TIMES_S = 10.0 * torch.arange(FRAMES, dtype=torch.float64)
PASSED = TIMES_S / TIMES_S[-1]


def drawn(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def levels(seed=1):
    """A level for each point, [P, 1]."""
    return 0.5 + 0.15 * drawn(POINTS, 1, seed=seed)


COOLING = levels() + 0.1 * drawn(POINTS, 1, seed=8) * torch.exp(-3 * PASSED)
DRIFTING = levels() + 0.02 * drawn(FRAMES, seed=9)
NOTHING = Model()


def positions():
    """Places in the image [P, F, 2] through which points move."""
    frame, phases = torch.arange(FRAMES, dtype=torch.float64), 3 * drawn(POINTS, 2, 1, seed=2)
    return torch.stack([torch.sin(0.7 * frame + phases[:, 0]), torch.sin(1.1 * frame + phases[:, 1])], 2)


def data_of(values, still=False, effects=CATALOGUE, noise=NOISE, **more):
    """What the joint fit sees of values [P, F]: noise is added; the camera moves around the points, or stands still."""
    points = drawn(POINTS, 3, seed=4)
    turn = torch.zeros(FRAMES) if still else torch.sin(1.7 * torch.arange(FRAMES))
    height = torch.zeros(FRAMES) if still else torch.cos(2.3 * torch.arange(FRAMES))
    centres = 6.0 * torch.stack([turn.sin(), 0.5 * height, turn.cos()], 1).double()
    towards = centres - points[:, None]
    places = positions()[:, :1].expand(-1, FRAMES, -1) if still else positions()
    values = values.expand(POINTS, FRAMES) + noise * drawn(POINTS, FRAMES, seed=5)
    tracks = Tracks(
        points=points,
        values=values,
        slopes=torch.zeros_like(values),
        weights=torch.ones_like(values),
        distances=towards.norm(dim=2),
        directions=functional.normalize(towards, dim=2),
        positions=places,
        radii=(places**2).sum(2) / 2,
    )
    terms = {effect.name: effect for effect in effects if effect.term is not None}
    return Data(terms, tracks, TIMES_S, None, noise, **more)


def fit_to(values, **more):
    return fit_of(data_of(values, **more))
