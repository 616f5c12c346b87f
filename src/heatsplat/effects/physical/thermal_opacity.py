"""Matter that one modality passes and the other does not."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from heatsplat.contracts import SceneData, evenly_spread
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection
from heatsplat.effects.observations import MAX_FRAMES, MIN_FRAMES, NEARER, between, counted_between, placed

MAX_POINTS = 6000
BESIDE_PX = 2.0  # points that fall into one square of this size are on one line of sight
SURE = 4.0  # a vote counts where one variance is this many times the other
STRAY = 0.05  # share of votes that differ at the edges of opaque things
MIN_VOTES = 12
PRESENT, UNLIKELY = 0.8, 0.05  # share of votes that differ where it is there, and a chance that so few of them do


def evidence(inspected: Inspection) -> Evidence:
    """Whether visible images show points that thermal images do not, or the other way round.

    Where a farther point lies behind a nearer one, one of the two keeps its value from view to view and the other shows
    whatever comes before it. Behind matter that is opaque to both, both modalities keep the nearer one.
    """
    obs = inspected.obs
    if obs.tracks is None or obs.still:
        return Evidence(None, obs.why or "a camera that stands still sees no parallax")
    votes = _votes(inspected.scene)
    if votes is None:
        return Evidence(None, "not every training view has a visible image of the thermal image's size")
    thermal, visible = votes
    if inspected.joint is not None and inspected.certainty.may_warm:
        # What is lit or cools changes by itself, so that a thermal image that varies says nothing of what it shows.
        thermal = thermal.clamp_min(0)
    sure = (thermal != 0) & (visible != 0)
    n, apart = int(sure.sum()), int((thermal[sure] != visible[sure]).sum())
    if n < MIN_VOTES:
        why = f"of the points behind others, both modalities could tell {n} apart"
        told = (
            apart == 0
            or sum(math.comb(n, k) * PRESENT**k * (1 - PRESENT) ** (n - k) for k in range(apart + 1)) < UNLIKELY
        )
        return Evidence(0.0, why if told else f"cannot be told: {why}, {MIN_VOTES} are needed", told=told)
    usual = STRAY * n
    return Evidence(
        (apart - usual) / math.sqrt(usual + 1.0),
        f"of {n} points that lie behind others, {apart} are seen by one modality and hidden from the other",
    )


def missing(scene: SceneData) -> str | None:
    """Which view lacks a visible image."""
    views = (view for part in (scene.train, scene.val, scene.test) for view in part)
    bare = next((view.frame.name for view in views if view.rgb is None), None)
    return None if bare is None else f"view {bare} has no visible image, which every view needs"


def _votes(scene: SceneData) -> tuple[Tensor, Tensor] | None:
    """For each point that lies behind others in some frames, 1 where the nearer one keeps its value, -1 where the farther
    one does, 0 where neither does clearly: by the thermal and by the visible images."""
    points = scene.points.double()[torch.tensor(evenly_spread(len(scene.points), MAX_POINTS))]
    chosen, count = evenly_spread(len(scene.train), MAX_FRAMES), len(points)
    shape = (count, len(chosen))
    inside, behind = torch.zeros(shape, dtype=torch.bool), torch.full(shape, -1)
    values, colours = torch.zeros(*shape, 1), torch.zeros(*shape, 3)
    for f, i in enumerate(chosen):
        view = scene.train[i]
        if view.thermal is None:
            continue
        if view.rgb is None or view.rgb.shape[:2] != view.thermal.shape[:2]:
            return None
        seen = placed(points, view.camera)
        inside[:, f], position = seen.inside, seen.positions.float()
        if view.mask is not None:
            inside[:, f] &= counted_between(view.mask, position)
        behind[:, f] = _nearer(seen.pixels, seen.depths, inside[:, f], int(view.camera.width / BESIDE_PX) + 2)
        values[:, f] = between(view.thermal.mean(2, keepdim=True).float(), position)
        colours[:, f] = between(view.rgb.float(), position)
    hidden = behind >= 0
    found = []
    for series in (values, colours):
        level = series.mean(2) if series.shape[2] == 1 else series
        level = level.reshape(*shape, -1)
        far, near = _variance(level, hidden), _variance(level, inside & ~hidden)
        before = torch.where(hidden, near[behind.clamp_min(0)], torch.nan).nanmedian(1).values
        ratio = far / before
        vote = (ratio > SURE).long() - (ratio < 1.0 / SURE).long()
        found.append(torch.where(ratio.isfinite(), vote, 0))
    return found[0], found[1]


def _nearer(pixels: Tensor, depths: Tensor, inside: Tensor, across: int) -> Tensor:
    """Which point [n] lies nearest to the camera in the same small square, where it is nearer by far; else -1."""
    squares = (pixels[:, 1] / BESIDE_PX).long() * across + (pixels[:, 0] / BESIDE_PX).long()
    ids = inside.nonzero()[:, 0]
    order = ids[depths[ids].argsort(stable=True)]  # the nearest first
    none = len(order)
    first = torch.full((int(squares[ids].max()) + 1 if len(ids) else 1,), none)
    first.scatter_reduce_(0, squares[order], torch.arange(none), "amin")
    order = torch.cat([order, order.new_tensor([-1])])
    nearest = torch.where(inside, order[first[squares.clamp(0, len(first) - 1)]], -1)
    much = depths > (1.0 + NEARER) * depths[nearest.clamp_min(0)]
    return torch.where(inside & (nearest >= 0) & much, nearest, -1)


def _variance(series: Tensor, keep: Tensor) -> Tensor:
    """Variance [P] of series [P, F, C] over the frames that are kept, summed over C; nan where there are too few."""
    weights = keep[..., None].to(series)
    n = weights.sum(1).clamp_min(1.0)
    mean = (series * weights).sum(1) / n
    variance = ((series - mean[:, None]) ** 2 * weights).sum(1) / n
    return torch.where(keep.sum(1) >= MIN_FRAMES, variance.sum(1) + 1e-7, torch.nan)


EFFECT = Effect(
    name="thermal_opacity",
    stage="visibility",
    place=0,
    summary="materials that are transparent in one modality and opaque in the other",
    source="RaViGS, Eq. 6",
    null="of two points behind one pixel both modalities show the nearer one",
    # Standard deviations of the number of stray votes; up to 1.3 without it, from 16 with it.
    threshold=4.0,
    adds="a second opacity for each Gaussian, training on visible images too",
    evidence=evidence,
    part=Part("companion", "companion"),
    missing=missing,
)
