"""Which pixels a metric counts."""

from __future__ import annotations

import torch
from torch import Tensor


def valid_pixels(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Pixels that count, [H, W] bool: inside the mask, and known (not NaN) in the ground truth.

    A prediction that is not finite is never skipped: a score over the other pixels would flatter a broken model.

    Args:
        prediction: [H, W, C].
        target: [H, W, C] ground truth; NaN where the camera gave none.
        mask: [H, W] bool, True where a pixel counts; None means that all do.

    Raises:
        ValueError: shapes differ, or the prediction has NaN or infinite values where the ground truth is known.
    """
    if prediction.ndim != 3 or prediction.shape != target.shape:
        raise ValueError(
            f"a metric needs two images [H, W, C] of one shape, got prediction {list(prediction.shape)} and ground "
            f"truth {list(target.shape)}"
        )
    valid = torch.isfinite(target).all(-1)
    if mask is not None:
        if tuple(mask.shape) != tuple(target.shape[:2]):
            raise ValueError(f"mask must be [H, W] = {list(target.shape[:2])}, got {list(mask.shape)}")
        valid &= mask.to(valid)
    broken = int((~torch.isfinite(prediction).all(-1) & valid).sum())
    if broken:
        raise ValueError(
            f"prediction has {broken} pixels that are NaN or infinite where the ground truth is known; a score over "
            "the rest would hide it. Turn on callbacks.finite, which names the tensor that became NaN."
        )
    return valid


def saturated_fraction(target: Tensor, valid: Tensor) -> float | None:
    """Share of the counted pixels whose ground truth is 0 or 1, where a camera may have clipped; None if none counts.

    Saturated pixels are counted, not removed: bounds are often the extremes of the data, so 0 and 1 are honest values
    too.
    """
    values = target[valid]
    if values.numel() == 0:
        return None
    return ((values <= 0) | (values >= 1)).all(-1).double().mean().item()
