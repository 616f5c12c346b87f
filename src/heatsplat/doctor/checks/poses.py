"""Poses against images: whether scene points look alike where two cameras say that they are."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import Camera, evenly_spread
from heatsplat.doctor.base import Check, Finding, Material, some
from heatsplat.effects.observations import standardised
from heatsplat.geometry.projection import to_world

PAIRS, POINTS, CANDIDATES = 10, 100, 1500
HALF, REACH = 4, 5  # pixels: half a patch, and how far a point is looked for about where it should be
STRUCTURE = 4.0  # a patch counts whose standard deviation is this many times the noise
ALIKE = 0.75  # correlation from which two patches show the same
MIN_POINTS = 12
AT_ONCE = 8  # points that are looked for together
# A frame is wrong where more than this share of its points lies further off: a part of them may lie behind glass, or hidden.
SHARE, FAR_PX = 0.7, 2.5
WRONG = 1 / 3  # share of such frames from which poses are wrong; panes and what moves take some
# Cosine between two cameras' axes, 18°: with exact poses, patches are alike at one to three in four points at 2 to 12°, and at
# one in four at 24 to 31°, where surfaces no longer look as if they faced the camera.
SAME_WAY = 0.95


def find(material: Material) -> list[Finding]:
    cameras, points = material.cameras, material.points
    if cameras is None or points is None or len(points) < MIN_POINTS or len(cameras) < 3:
        return []
    points = points[torch.tensor(evenly_spread(len(points), CANDIDATES))].double()
    shifts, shares, names = [], [], []
    for one in evenly_spread(len(cameras), PAIRS):
        other = _beside(cameras, one, material.near_in_time(one))
        if other is None:
            continue
        told = _shifts(material, one, other, points)
        if told is None:
            continue
        shift, share = told
        shifts.append(shift)
        shares.append(share)
        names.append(material.name(one))
    if len(shifts) < 2:
        return []
    shift, share = torch.tensor(shifts), torch.tensor(shares)
    wrong = shift > FAR_PX
    if wrong.sum() <= WRONG * len(wrong):
        return []
    bad = tuple(name for name, is_bad in zip(names, wrong.tolist(), strict=True) if is_bad)
    px = float(shift[wrong].median())
    slope = _slope(material)
    return [
        Finding(
            "poses",
            min(1.0, max(px, 1.0) * slope / material.contrast) + 0.5 * float(1.0 - share[wrong].median()),
            f"In {len(bad)} of {len(wrong)} frames that were looked at, seven in ten points lie {px:.1f} pixels and more "
            f"from where the poses say, and {100 * float(share[wrong].median()):.0f} % are where they should be ({some(bad)}).",
            "Check that names of images and poses belong together, and that no image is turned; else find poses "
            "anew: python src/prepare.py source=... target=...",
            bad,
        )
    ]


def _beside(cameras: list[Camera], one: int, near: Tensor) -> int | None:
    """The nearest other camera of ``near`` that looks the same way and does not stand at the same place."""
    centers = torch.stack([camera.center for camera in cameras])
    axes = torch.stack([camera.viewmat[2, :3] for camera in cameras])
    apart = (centers - centers[one]).norm(dim=1)
    size = (centers - centers.mean(0)).norm(dim=1).max()
    usable = near & (axes @ axes[one] > SAME_WAY) & (apart > 1e-3 * size)
    if not usable.any():
        return None
    return int(torch.where(usable, apart, torch.inf).argmin())


def _shifts(material: Material, one: int, other: int, points: Tensor) -> tuple[float, float] | None:
    """Pixels beyond which seven in ten points lie of where they should, and the share of them that lies nearer than FAR_PX."""
    camera, second = material.cameras[one], material.cameras[other]
    pixels, depth = camera.project(points)
    there, depth_there = second.project(points)
    inside = _inside(pixels, depth, camera, HALF + 1) & _inside(there, depth_there, second, HALF + REACH + 2)
    pixels, depth = pixels[inside], depth[inside]
    if len(depth) < MIN_POINTS:
        return None
    at = torch.arange(-HALF, HALF + 1, dtype=torch.float64)
    patch = torch.stack(torch.meshgrid(at, at, indexing="xy"), -1).reshape(-1, 2)
    first = _sampled(material.image(one), pixels[:, None] + patch)
    strong = first.std(1) * _corner(first)
    keep = strong.argsort(descending=True)[:POINTS]
    keep = keep[first.std(1)[keep] > STRUCTURE * material.noise]
    if len(keep) < MIN_POINTS:
        return None
    first, pixels, depth = first[keep], pixels[keep], depth[keep]
    # The patch lies on a plane that faces the first camera.
    rays = (
        torch.linalg.solve(camera.K, functional.pad(pixels[:, None] + patch, (0, 1), value=1.0).mT).mT
        * depth[:, None, None]
    )
    base = second.project(to_world(rays, camera.viewmat).reshape(-1, 3))[0].reshape(len(keep), -1, 2)
    steps = torch.arange(-REACH, REACH + 1, dtype=torch.float64)
    moves = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).reshape(-1, 2)
    best, where = _alike(standardised(first), material.image(other), base, moves).max(1)
    found = best > ALIKE
    shift = torch.where(found, moves[where].norm(dim=1), float(REACH + 1))
    return float(shift.quantile(1.0 - SHARE)), float((shift <= FAR_PX).double().mean())


def _alike(patterns: Tensor, image: Tensor, base: Tensor, moves: Tensor) -> Tensor:
    """Correlation [n, m] of ``patterns`` [n, k], which have no mean and length 1, with what an image [H, W] shows at their places
    ``base`` [n, k, 2] after each of ``moves`` [m, 2]; a few points at a time, which stay in the cache."""
    alike = []
    for pattern, around in zip(patterns.split(AT_ONCE), base.split(AT_ONCE), strict=True):
        seen = _sampled(image, around[:, None] + moves[:, None])
        seen -= seen.mean(2, keepdim=True)
        alike.append((seen @ pattern[:, :, None])[..., 0] / seen.norm(dim=2).clamp_min(1e-12))
    return torch.cat(alike)


def _corner(patches: Tensor) -> Tensor:
    """How much patches [n, (2 HALF + 1)²] change in the direction in which they change least, relative to the most."""
    image = patches.reshape(len(patches), 2 * HALF + 1, 2 * HALF + 1)
    x, y = image.diff(dim=2)[:, :-1].flatten(1), image.diff(dim=1)[:, :, :-1].flatten(1)
    a, b, c = (x * x).sum(1), (y * y).sum(1), (x * y).sum(1)
    root = torch.sqrt((a - b).square() + 4 * c.square())
    return (a + b - root) / (a + b + root).clamp_min(1e-30)


def _inside(pixels: Tensor, depth: Tensor, camera: Camera, margin: float) -> Tensor:
    extent = pixels.new_tensor([camera.width, camera.height])
    return (depth > 1e-9) & (pixels > margin).all(1) & (pixels < extent - margin).all(1)


def _sampled(image: Tensor, pixels: Tensor) -> Tensor:
    """Values [...] of an image [H, W] at pixels [..., 2], bilinear."""
    extent = pixels.new_tensor([image.shape[1], image.shape[0]])
    grid = torch.addcmul(extent.new_tensor(-1.0), pixels, 2.0 / extent).reshape(1, 1, -1, 2)
    values = functional.grid_sample(image[None, None].nan_to_num(), grid, align_corners=False, padding_mode="border")
    return values.reshape(pixels.shape[:-1])


def _slope(material: Material) -> float:
    """How much neighbouring pixels differ (root mean square)."""
    squares = [material.image(f).diff(dim=1).square().nanmean() for f in range(len(material.images))]
    return float(torch.stack(squares).mean().sqrt())


CHECK = Check("poses", "scene points look alike where two cameras say that they are", find)
