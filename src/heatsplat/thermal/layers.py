"""Random starts of networks from the run's own generator, so that a run is the same whatever ran before it."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import nn


@torch.no_grad()
def draw_uniform(layers: Iterable[nn.Linear], generator: torch.Generator, shrink: float = 1.0) -> None:
    """Draws weights and biases of layers in ±shrink / √inputs, torch's own start of linear layers."""
    for layer in layers:
        bound = shrink / math.sqrt(layer.in_features)
        for parameter in layer.parameters():
            nn.init.uniform_(parameter, -bound, bound, generator=generator)
