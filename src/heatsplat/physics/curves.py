"""Smooth curves through values at even steps."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.nn import functional


def cubic_rows(places: Tensor, count: int) -> Tensor:
    """What each of ``count`` values at 0, 1, ..., count - 1 adds to a smooth curve through them, at ``places``: [F, count].

    Cubics that meet with one slope, that of the straight line between both neighbours (Catmull and Rom 1974); at the ends
    the curve goes on straight. A straight line stays one, and rows add up to 1.

    Args:
        places: [F] float64 from 0 to count - 1.
    """
    before = places.long().clamp(0, count - 2)
    u = (places - before)[:, None]
    eye = torch.eye(count, dtype=places.dtype)
    beyond = torch.cat([2 * eye[:1] - eye[1:2], eye, 2 * eye[-1:] - eye[-2:-1]])
    a, b, c, d = (beyond[before + k] for k in range(4))
    return b + 0.5 * u * (c - a + u * (2 * a - 5 * b + 4 * c - d + u * (3 * (b - c) + d - a)))


def resampled_values(values: Sequence[float], count: int) -> Tensor:
    """``count`` values [count] float32 over the same span as those given, linear between them; for 1, their mean."""
    given = torch.tensor(values, dtype=torch.float32)
    if count == 1:
        return given.mean()[None]
    return functional.interpolate(given[None, None], count, mode="linear", align_corners=True)[0, 0]


def smooth_values(places: Tensor, heights: Tensor, count: int, smooth: float) -> Tensor:
    """Values [count] whose curve (``cubic_rows``) comes closest to ``heights`` at ``places``, and bends little elsewhere.

    Args:
        places: [F] float64 from 0 to count - 1.
        heights: [F] float64.
        smooth: weight of the mean squared second difference beside the mean squared distance; positive where places leave
            values open.
    """
    rows = cubic_rows(places, count)
    bends = torch.eye(count, dtype=places.dtype).diff(n=2, dim=0) * (smooth / max(count - 2, 1)) ** 0.5
    wanted = torch.cat([heights / len(heights) ** 0.5, heights.new_zeros(len(bends))])
    return torch.linalg.lstsq(torch.cat([rows / len(heights) ** 0.5, bends]), wanted[:, None]).solution[:, 0]
