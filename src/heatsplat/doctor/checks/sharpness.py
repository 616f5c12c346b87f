"""Frames that are blurred: out of focus, or moved while they were taken."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.doctor.base import Check, Finding, Material, some

BLURRED = 0.7  # of the sharpness of the frames around
CLEAR = 8.0  # contrast in noise from which sharpness can be told


def find(material: Material) -> list[Finding]:
    if len(material.images) < 6 or min(material.images.shape[1:]) < 24 or material.contrast < CLEAR * material.noise:
        return []
    sharp = torch.tensor([_sharpness(image, material.noise) for image in material.images], dtype=torch.float64)
    around = torch.stack([sharp[max(0, f - 4) : f + 5].median() for f in range(len(sharp))])
    worst = [f for f in range(len(sharp)) if float(sharp[f]) < BLURRED * float(around[f])]
    if not worst:
        return []
    names = [material.name(f) for f in worst]
    along = sum(_direction(material.images[f]) for f in worst) / len(worst)
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


def _sharpness(image: Tensor, noise: float) -> float:
    """Fine gradients over coarse ones: the strongest hundredth at single pixels, and after a mean over 4."""
    image = image.nan_to_num()
    fine = (
        _gradient(image).flatten().square().topk(max(1, image.numel() // 100)).values.mean() - 2 * noise**2
    ).clamp_min(0)
    coarse = functional.avg_pool2d(image[None, None], 4, stride=1)[0, 0]
    rough = _gradient(coarse).flatten().square().topk(max(1, coarse.numel() // 100)).values.mean()
    return float((fine / rough.clamp_min(1e-18)).sqrt())


def _gradient(image: Tensor) -> Tensor:
    return torch.hypot(image.diff(dim=1)[:-1], image.diff(dim=0)[:, :-1])


def _direction(image: Tensor) -> float:
    """How much more gradients there are in one direction than across it, 0 to 1."""
    x, y = image.nan_to_num().diff(dim=1)[:-1], image.nan_to_num().diff(dim=0)[:, :-1]
    a, b, c = (x * x).mean(), (y * y).mean(), (x * y).mean()
    return float(torch.sqrt((a - b).square() + 4 * c.square()) / (a + b).clamp_min(1e-18))


CHECK = Check("sharpness", "frames that are far less sharp than those around", find)
