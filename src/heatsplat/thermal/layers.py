"""Layers of networks: the last one, and random starts from the run's own generator, whatever ran before the run."""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor, nn

from heatsplat.same_bits import to_one


class Head(nn.Linear):
    """A last layer, [..., inputs] to [..., outputs], which learns the same bits with any number of threads."""

    def forward(self, values: Tensor) -> Tensor:
        return super().forward(values) if self.out_features > 1 else to_one(values, self.weight, self.bias)


@torch.no_grad()
def draw_uniform(layers: Iterable[nn.Linear], generator: torch.Generator, shrink: float = 1.0) -> None:
    """Draws weights and biases of layers in ±shrink / √inputs, torch's own start of linear layers."""
    for layer in layers:
        bound = shrink / math.sqrt(layer.in_features)
        for parameter in layer.parameters():
            nn.init.uniform_(parameter, -bound, bound, generator=generator)
