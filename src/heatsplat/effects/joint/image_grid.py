"""Offsets and gains that vary over the image."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.observations import Tracks

STILL = "a camera that stands still cannot tell its pattern from the scene"


def grid_columns(tracks: Tracks, image: Tensor, nodes: int) -> Columns:
    """2 nodes² columns: offsets and gains on a grid of ``nodes`` by ``nodes`` over the image [P, F], straight in between."""
    along = (tracks.positions.clamp(-1, 1) + 1) * (0.5 * (nodes - 1))
    cell = along.floor().clamp_max(nodes - 2)
    share = along - cell  # of the next node
    (row, column), (down, right) = cell.long().unbind(2), share.unbind(2)
    corners = [(0, 0), (0, 1), (1, 0), (1, 1)]
    slots = torch.stack([(row + i) * nodes + column + j for i, j in corners], 2)
    values = torch.stack([(down if i else 1.0 - down) * (right if j else 1.0 - right) for i, j in corners], 2)
    places = Columns(slots, values, nodes**2)
    return Columns.joined([places, places * image[..., None]])
