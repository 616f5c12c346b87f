"""Focal length against images: whether points read the same in all frames where the images are taken for larger or smaller."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.doctor.base import MIN_FRAMES, MIN_POINTS, Check, Finding, Material, shrunk
from heatsplat.doctor.courses import beside_courses
from heatsplat.effects.observations import between, slopes
from heatsplat.physics.noise import MAD_TO_SIGMA, robust_spread

WIDTHS = (24, 48, 96, 192)  # pixels across of the images in which it is looked for, one after the other
STEPS, ROUNDS = 3, 5
LEAST = 0.02  # share of the focal length; structure from motion is often off by a hundredth
SURE = 5.0  # standard errors
# Pixels by which what a focal length moves at the edge of an image is off, whatever the image's size: with true cameras 0.2 to
# 0.95 in images 10 to 64 pixels wide. That is a twelfth of the focal length in
# the smallest images that are looked at, WIDTHS[0] across.
EDGE = 1.0
# The spread of a point over frames has to fall to this share. Where nothing is wrong it falls to 0.93 at the least.
BETTER = 0.85
WIDEST = 2.0  # factors beyond which nothing is looked for


def find(material: Material) -> list[Finding]:
    tracks = material.tracks
    if tracks is None or len(tracks.points) < MIN_POINTS or len(material.images) < MIN_FRAMES:
        return []
    side = max(material.images.shape[1:])
    if side < WIDTHS[0]:
        return []
    factor, error = fitting_factor(material)
    if abs(factor - 1.0) < max(LEAST, SURE * error, EDGE / (0.5 * side)):
        return []
    before, after = (_spread(material, one, factor) for one in (1.0, factor))
    if after > BETTER * before:
        return []
    focal = float(material.cameras[0].K[0, 0])
    return [
        Finding(
            "focal",
            (before**2 - after**2) ** 0.5 / material.contrast,
            f"The images fit poses and points best with a focal length of {factor * focal:.4g} pixels, which is "
            f"{abs(100 * (factor - 1)):.0f} % {'more' if factor > 1 else 'less'} than the {focal:.4g} of the cameras (in images "
            f"of {material.grid}); a point then differs between frames by {material.size(after)}, and by "
            f"{material.size(before)} with theirs.",
            "Check fl_x or the cameras' parameters: the image size that they are for, and the pitch of pixels.",
        )
    ]


def fitting_factor(material: Material) -> tuple[float, float]:
    """By what the focal length has to be multiplied for points to read the same in all frames, and its standard error.

    Seen with a wrong one, a point at a place x from the principal point reads what lies off by a share of x, so that its
    value is off by that share of x·∇I. The share is fitted to coarse images first, in which even a large one is less than a
    pixel (Lucas and Kanade 1981).
    """
    tracks, (height, width) = material.tracks, material.images.shape[1:]
    away, middle = _from_the_middle(material)
    factor, error = 1.0, 0.0
    widths = (*(w for w in WIDTHS if w < width), min(width, WIDTHS[-1]))
    grids = [(max(8, round(wide * height / width)), wide) for wide in widths]
    for high, wide in grids:
        images = [shrunk(material.image(f), (high, wide)) for f in range(len(material.images))]
        half = tracks.positions.new_tensor([0.5 * wide, 0.5 * high])
        for _ in range(STEPS):
            places = middle + factor * away
            values = torch.stack([between(one[..., None], places[:, f])[:, 0] for f, one in enumerate(images)], 1)
            steep = torch.stack([slopes(one, places[:, f]) for f, one in enumerate(images)], 1)
            pulled = (steep * (factor * away * half)).sum(2)
            seen = (tracks.weights > 0) & (places.abs() < 1.0).all(2)
            share, error = _share(material, values, pulled, seen)
            factor = min(max(factor * (1.0 - share), 1.0 / WIDEST), WIDEST)
    return factor, error


def _from_the_middle(material: Material) -> tuple[Tensor, Tensor]:
    """Where points are from the principal points [P, F, 2], and these [F, 2], from -1 to 1 over the image."""
    size = torch.tensor(material.images.shape[:0:-1], dtype=torch.float64)
    middle = torch.stack([2.0 * camera.K[:2, 2] / size - 1.0 for camera in material.cameras])
    return material.tracks.positions - middle, middle


def _share(material: Material, values: Tensor, pulled: Tensor, seen: Tensor) -> tuple[float, float]:
    """What of ``pulled`` [P, F] is in values beside each point's own course, and its standard error; robust."""
    weights = seen.double()
    for _ in range(ROUNDS):
        value, counts = beside_courses(values, weights, material)
        pull, _ = beside_courses(pulled, weights, material)
        inner = (counts * pull * pull).sum().clamp_min(1e-30)
        share = (counts * pull * value).sum() / inner
        left = value - share * pull
        own = MAD_TO_SIGMA * torch.where(seen, left.abs(), torch.nan).nanmedian(1, keepdim=True).values
        own = own.nan_to_num(torch.inf).clamp_min(float(own[own.isfinite()].median().clamp_min(1e-9)))
        weights = (1.0 - (left / (5.0 * own)) ** 2).clamp_min(0.0) ** 2 * seen / own**2
    pulls = counts * left * pull
    error = max(float(pulls.sum(axis).square().sum().sqrt() / inner) for axis in (0, 1))
    return float(share), error


def _spread(material: Material, factor: float, other: float) -> float:
    """How much points differ between frames where they are read with a factor; of those that are seen with both."""
    away, middle = _from_the_middle(material)
    places = middle + factor * away
    seen = (material.tracks.weights > 0) & (places.abs() < 1.0).all(2) & ((middle + other * away).abs() < 1.0).all(2)
    images = (material.image(f).nan_to_num() for f in range(len(material.images)))
    values = torch.stack([between(image[..., None], places[:, f])[:, 0] for f, image in enumerate(images)], 1)
    left, counts = beside_courses(values, seen.double(), material)
    return robust_spread(torch.where(counts > 0, left, torch.nan))


CHECK = Check("focal", "whether images fit poses and points best with the focal length that they have", find)
