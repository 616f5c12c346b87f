"""A residual perceptron whose input is part per Gaussian and part the same for all of them."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn.functional import silu

from heatsplat.thermal.layers import Head, draw_uniform


class ResidualNetwork(nn.Module):
    """Hidden values of ``blocks`` residual blocks (two layers each), and heads on them.

    The first layer is linear, so its two parts are evaluated apart: what belongs to a Gaussian once for all moments,
    what belongs to a moment once for all Gaussians.

    Args:
        own: inputs per Gaussian.
        shared: inputs that all Gaussians share.
        width, blocks: size of the hidden layers and number of blocks.
        heads: name -> what the head gives before training, [k]; its weights start at zero.
    """

    def __init__(self, own: int, shared: int, width: int, blocks: int, heads: dict[str, Tensor]) -> None:
        super().__init__()
        self.own = nn.Linear(own, width)
        self.shared = nn.Linear(shared, width, bias=False)
        self.blocks = nn.ModuleList(
            nn.ModuleList((nn.Linear(width, width), nn.Linear(width, width))) for _ in range(blocks)
        )
        self.heads = nn.ModuleDict({name: Head(width, len(start)) for name, start in heads.items()})
        with torch.no_grad():
            for name, start in heads.items():
                self.heads[name].weight.zero_()
                self.heads[name].bias.copy_(start)

    @torch.no_grad()
    def draw(self, generator: torch.Generator) -> None:
        """Gives all layers but the heads random weights; the second layer of a block starts small (Zhang et al. 2019)."""
        inputs = self.own.in_features + self.shared.in_features  # of the one layer that both are parts of
        for layer in (self.own, self.shared):
            draw_uniform((layer,), generator, math.sqrt(layer.in_features / inputs))
        for first, second in self.blocks:
            draw_uniform((first,), generator)
            draw_uniform((second,), generator, 1 / math.sqrt(len(self.blocks)))

    def forward(self, base: Tensor, moment: Tensor) -> Tensor:
        """Hidden values [n, width].

        Args:
            base: [n, width], ``self.own`` of what belongs to the Gaussians.
            moment: [shared].
        """
        hidden = base + self.shared(moment)
        for first, second in self.blocks:
            hidden = hidden + second(silu(first(silu(hidden))))
        return silu(hidden)

    @property
    def cost(self) -> int:
        """Multiply-adds per Gaussian up to the hidden values, the shared inputs left out."""
        inner = sum(layer.weight.numel() for block in self.blocks for layer in block)
        return self.own.weight.numel() + inner
