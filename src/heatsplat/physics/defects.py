"""Pixels of a detector that do not work, told from what they show while the camera moves."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

# A pixel is dead where it differs from the median about it by this many deviations of its frame, in this share of frames.
DEVIATIONS, NEARLY_ALL = 6.0, 0.9
MIN_FRAMES = 4
_MAD_TO_SIGMA = 1.4826


def dead_pixels(images: Tensor) -> Tensor:
    """Pixels [H, W] bool that differ from their surroundings (5 x 5) in nearly all of the images [F, H, W]; NaN is unknown.

    None where there are fewer than four images: a still object may look like it.
    """
    if len(images) < MIN_FRAMES or min(images.shape[1:]) < 5:
        return torch.zeros(images.shape[1:], dtype=torch.bool)
    votes = torch.zeros(images.shape[1:], dtype=torch.int64)
    signs = torch.zeros(images.shape[1:], dtype=torch.int64)
    for image in images:
        level = image.nanmedian().nan_to_num()
        known = torch.where(image.isfinite(), image, level)
        wide = functional.pad(known[None, None], (2, 2, 2, 2), mode="replicate")
        around = functional.unfold(wide, 3, dilation=2)[0]  # every other pixel: a dead neighbour does not count
        away = known - around.median(dim=0).values.reshape(image.shape)
        far = away.abs() > DEVIATIONS * (_MAD_TO_SIGMA * away.abs().median()).clamp_min(1e-9)
        votes += far
        signs += far * away.sign().long()
    return (votes >= NEARLY_ALL * len(images)) & (signs.abs() >= NEARLY_ALL * len(images))
