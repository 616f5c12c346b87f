"""Frames that are blurred: out of focus, or moved while they were taken.

Blur of 0.8 pixels nearly halves this measure, which is what a threshold wants; it takes a sixth off that of
``preparation.sharpness``, which tells neighbours of a video apart.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import evenly_spread
from heatsplat.doctor.base import CLEAR, Check, Finding, Material, some
from heatsplat.physics.defects import dead_pixels

BLURRED = 0.7  # of the sharpness of the frames around
DEAD_FRAMES = 8  # from which dead pixels are told


def find(material: Material) -> list[Finding]:
    if len(material.images) < 6 or min(material.images.shape[1:]) < 24 or material.contrast < CLEAR * material.noise:
        return []
    dead = dead_pixels(
        material.images[evenly_spread(len(material.images), DEAD_FRAMES)].float()
    )  # sharp in every frame
    sharp = [_sharpness(*_filled(material, f, dead), material.noise) for f in range(len(material.images))]
    sharp = torch.tensor(sharp).double()
    around = torch.stack([sharp[max(0, f - 4) : f + 5].nanmedian() for f in range(len(sharp))])
    seen = [f for f in range(len(sharp)) if f not in material.blank]
    worst = [f for f in seen if float(sharp[f]) < BLURRED * float(around[f])]
    if not worst:
        return []
    names = [material.name(f) for f in worst]
    along = sum(_direction(*_filled(material, f, dead)) for f in worst) / len(worst)
    kind = "along one direction: motion" if along > 0.5 else "in all directions: focus, or motion along several"
    return [
        Finding(
            "sharpness",
            0.3 * len(worst) / len(sharp) + 0.02,
            f"{len(worst)} of {len(sharp)} frames are far less sharp than those around ({some(names)}), {kind}.",
            "Leave them out; move more slowly, or let the camera focus before recording.",
            tuple(names),
        )
    ]


def _filled(material: Material, frame: int, dead: Tensor) -> tuple[Tensor, Tensor]:
    """The image of a frame with its median where pixels do not count, and which of them do: none of the dead ones."""
    image, counts = material.image(frame), material.counts(frame) & ~dead
    if bool(counts.all()):
        return image, counts
    return image.where(counts, image[counts].median() if bool(counts.any()) else 0.0), counts


def _sharpness(image: Tensor, counts: Tensor, noise: float) -> float:
    """Fine gradients over coarse ones: the strongest hundredth at single pixels, and after a mean over 4; NaN where none is
    known."""
    fine = _strongest(image, counts)
    coarse, whole = (functional.avg_pool2d(x[None, None].double(), 4, stride=1)[0, 0] for x in (image, counts))
    rough = _strongest(coarse, whole > 1 - 1e-9)
    return float(((fine - 2 * noise**2).clamp_min(0) / rough.clamp_min(1e-18)).sqrt())


def _strongest(image: Tensor, counts: Tensor) -> Tensor:
    """Mean square of the strongest hundredth of the gradients between pixels that count."""
    x, y, inside = _steps(image, counts)
    squares = (x.square() + y.square())[inside]
    return squares.topk(max(1, len(squares) // 100)).values.mean() if len(squares) else squares.new_tensor(torch.nan)


def _steps(image: Tensor, counts: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Differences to the right and down [H - 1, W - 1], and at which pixels they are between ones that count."""
    inside = counts[:-1, :-1] & counts[:-1, 1:] & counts[1:, :-1]
    return image.diff(dim=1)[:-1], image.diff(dim=0)[:, :-1], inside


def _direction(image: Tensor, counts: Tensor) -> float:
    """How much more gradients there are in one direction than across it, 0 to 1."""
    *steps, inside = _steps(image, counts)
    x, y = (step[inside] for step in steps)
    a, b, c = (x * x).mean(), (y * y).mean(), (x * y).mean()
    return float(torch.sqrt((a - b).square() + 4 * c.square()) / (a + b).clamp_min(1e-18))


CHECK = Check("sharpness", "frames that are far less sharp than those around", find)
