"""What surfaces see of sun and sky: the directions in which it is asked, and what comes of the answers.

**Convention:** directions are unit vectors towards sun or sky in the world's axes; of an answer, 1 is open and 0 is hidden.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

APART = math.radians(1.25)  # of directions of the sun: five minutes of its way


def sun_directions(sun: Tensor, up: Tensor) -> Tensor:
    """Directions [D, 3] such that each that the sun [T, 3] has above the horizon [up: 3] is within 1.25 degrees of one."""
    found: list[Tensor] = []
    for direction in sun[sun @ up.to(sun) > 0]:
        if not found or float((torch.stack(found) @ direction).max()) < math.cos(APART):
            found.append(direction)
    return torch.stack(found) if found else sun.new_zeros(0, 3)


def sky_directions(count: int, up: Tensor) -> Tensor:
    """Directions [count, 3] float64 above the horizon that stand for equal parts of the hemisphere (a spiral)."""
    number = torch.arange(count, dtype=torch.float64)
    height, angle = (number + 0.5) / count, number * math.pi * (3.0 - 5.0**0.5)
    level = (1.0 - height**2).sqrt()
    aside = torch.linalg.svd(up.double()[None]).Vh[1:]
    return height[:, None] * up + level[:, None] * (angle.cos()[:, None] * aside[0] + angle.sin()[:, None] * aside[1])


def open_share(normals: Tensor, directions: Tensor, seen: Tensor) -> Tensor:
    """Share [N] of the sky's light that reaches surfaces with normals [N, 3], of what they would get without obstacles.

    The sky is equally bright all over; ``seen`` [N, K] says which parts of it are open, along directions [K, 3].
    """
    weights = (normals @ directions.T.to(normals)).clamp(min=0.0)
    return (weights * seen).sum(1) / weights.sum(1).clamp(min=1e-6)
