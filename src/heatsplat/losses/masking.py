"""What masked pixels do to a loss: nothing. Masks are [H, W] bool, True where a pixel counts; None means that all do."""

from __future__ import annotations

import torch
from scipy.ndimage import distance_transform_edt
from torch import Tensor
from torch.nn import functional

from heatsplat.same_bits import mean, total


def cleared(image: Tensor, mask: Tensor | None) -> Tensor:
    """The image [H, W, C] with 0 where the mask is False, whatever stands there, NaN too; no gradient goes through these."""
    return image if mask is None else torch.where(mask[..., None], image, 0.0)


def filled(image: Tensor, mask: Tensor | None) -> Tensor:
    """The image [H, W, C] with the nearest pixel that counts in place of each that does not; 0 throughout where none does."""
    if mask is None or not bool(mask.any()):
        return cleared(image, mask)
    rows, columns = distance_transform_edt(~mask.cpu().numpy(), return_distances=False, return_indices=True)
    return image[torch.from_numpy(rows), torch.from_numpy(columns)]


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """The mean of [H, W, C] over the pixels that count and their channels; 0 where none counts."""
    if mask is None:
        return mean(values)
    return total(cleared(values, mask)) / (mask.sum() * values.shape[2]).clamp(min=1)


def eroded(mask: Tensor) -> Tensor:
    """Which pixels [H, W] count together with their eight neighbours (those outside the image do not matter)."""
    masked = functional.max_pool2d((~mask).float()[None, None], 3, stride=1, padding=1)[0, 0]
    return masked < 0.5
