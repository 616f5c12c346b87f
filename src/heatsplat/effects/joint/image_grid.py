"""Offsets and gains that vary over the image."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.effects.observations import Tracks

STILL = "a camera that stands still cannot tell its pattern from the scene"


def grid_columns(tracks: Tracks, image: Tensor, nodes: int) -> Tensor:
    """Columns [P, F, 2 nodes²]: offsets and gains on a grid of ``nodes`` by ``nodes`` over the image [P, F], straight in
    between."""
    along = (tracks.positions.clamp(-1, 1) + 1) * (0.5 * (nodes - 1))
    hats = (1.0 - (along[..., None] - torch.arange(nodes, dtype=image.dtype)).abs()).clamp_min(0.0)
    places = (hats[..., 0, :, None] * hats[..., 1, None, :]).flatten(2)
    return torch.cat([places, places * image[..., None]], 2)
