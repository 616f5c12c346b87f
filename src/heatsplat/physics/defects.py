"""Pixels of a detector that do not work, told from what they show while the camera moves."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.physics.noise import MAD_TO_SIGMA

# A pixel is dead where it differs from the median about it by this many deviations of its frame, in this share of frames.
DEVIATIONS, NEARLY_ALL = 6.0, 0.9
MIN_FRAMES = 4
# Correlation between images of what differs from its surroundings, dead pixels aside, from which the image stands still: 0.63
# in noisy repeats of one view, up to 0.04 in recordings by a camera that moves.
STILL = 0.12


def dead_pixels(images: Tensor) -> Tensor:
    """Pixels [H, W] bool that differ from their surroundings (5 x 5) in nearly all of the images [F, H, W]; NaN is unknown.

    None of them where there are fewer than four images, or where the image stands still: edges of the scene would look like
    dead pixels.
    """
    none = torch.zeros(images.shape[1:], dtype=torch.bool)
    if len(images) < MIN_FRAMES or min(images.shape[1:]) < 5:
        return none
    votes = torch.zeros(images.shape[1:], dtype=torch.int64)
    signs = torch.zeros(images.shape[1:], dtype=torch.int64)
    details = []
    for image in images:
        level = image.nanmedian().nan_to_num()
        known = torch.where(image.isfinite(), image, level)
        wide = functional.pad(known[None, None], (2, 2, 2, 2), mode="replicate")
        around = functional.unfold(wide, 3, dilation=2)[0]  # every other pixel: a dead neighbour does not count
        away = known - around.median(dim=0).values.reshape(image.shape)
        other = away[away != 0]  # on a slope many a pixel is itself the median about it, and says nothing of the noise
        limit = DEVIATIONS * (MAD_TO_SIGMA * other.abs().median()).nan_to_num().clamp_min(1e-9)
        far = away.abs() > limit
        votes += far
        signs += far * away.sign().long()
        details.append(away.clamp(-limit, limit))
    dead = (votes >= NEARLY_ALL * len(images)) & (signs.abs() >= NEARLY_ALL * len(images))
    return none if dead.any() and _stands_still(torch.stack(details)[:, ~dead]) else dead


def _stands_still(details: Tensor) -> bool:
    """Whether details [F, n] of images lie at the same pixels in all of them."""
    alike = torch.corrcoef(details)[*torch.triu_indices(len(details), len(details), 1)]
    return float(alike.nanmedian()) > STILL
