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
    counts = material.images.isfinite() if material.masks is None else material.images.isfinite() & material.masks
    images = [_filled(image, known) for image, known in zip(material.images, counts, strict=True)]
    sharp = torch.tensor([_sharpness(*pair, material.noise) for pair in zip(images, counts, strict=True)]).double()
    around = torch.stack([sharp[max(0, f - 4) : f + 5].nanmedian() for f in range(len(sharp))])
    worst = [f for f in range(len(sharp)) if float(sharp[f]) < BLURRED * float(around[f])]
    if not worst:
        return []
    names = [material.name(f) for f in worst]
    along = sum(_direction(images[f], counts[f]) for f in worst) / len(worst)
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


def _filled(image: Tensor, counts: Tensor) -> Tensor:
    """The image with its median where pixels do not count."""
    return image.where(counts, image[counts].median() if bool(counts.any()) else 0.0)


def _sharpness(image: Tensor, counts: Tensor, noise: float) -> float:
    """Fine gradients over coarse ones: the strongest hundredth at single pixels, and after a mean over 4; NaN where none is
    known."""
    fine = _strongest(image, counts)
    coarse, whole = (functional.avg_pool2d(x[None, None].double(), 4, stride=1)[0, 0] for x in (image, counts))
    rough = _strongest(coarse, whole > 1 - 1e-9)
    return float(((fine - 2 * noise**2).clamp_min(0) / rough.clamp_min(1e-18)).sqrt())


def _strongest(image: Tensor, counts: Tensor) -> Tensor:
    """Mean square of the strongest hundredth of the gradients between pixels that count."""
    x, y = _steps(image, counts)
    squares = x.square() + y.square()
    return squares.topk(max(1, len(squares) // 100)).values.mean() if len(squares) else squares.new_tensor(torch.nan)


def _steps(image: Tensor, counts: Tensor) -> Tensor:
    """Differences to the right and down [2, n] of the pixels that count with both of these neighbours."""
    inside = counts[:-1, :-1] & counts[:-1, 1:] & counts[1:, :-1]
    return torch.stack([image.diff(dim=1)[:-1][inside], image.diff(dim=0)[:, :-1][inside]])


def _direction(image: Tensor, counts: Tensor) -> float:
    """How much more gradients there are in one direction than across it, 0 to 1."""
    x, y = _steps(image, counts)
    a, b, c = (x * x).mean(), (y * y).mean(), (x * y).mean()
    return float(torch.sqrt((a - b).square() + 4 * c.square()) / (a + b).clamp_min(1e-18))


CHECK = Check("sharpness", "frames that are far less sharp than those around", find)
