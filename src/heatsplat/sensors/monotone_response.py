"""What the camera shows of what it receives: a curve that never falls (PhysIR-Splat)."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import Frame
from heatsplat.sensors.base import SensorPart
from heatsplat.sensors.tone import corrected


class MonotoneResponse(SensorPart):
    """A piecewise straight curve from 0 to 0 and from 1 to 1 that rises everywhere; beyond, slope 1.

    Rises between evenly spread nodes are a softmax of free numbers, so that no step can turn the curve over. Ends are
    fixed: a level and a factor that all brightnesses share belong to the scene.

    Args:
        pieces: of the curve; at least 2.
        weight: of the penalty, the mean squared logarithm of the slopes.
        lr, lr_end: learning rate and the factor on it at the end of the run.

    Raises:
        ValueError: there are fewer than two pieces.
    """

    def __init__(self, pieces: int = 16, weight: float = 1e-3, lr: float = 5e-3, lr_end: float = 0.1) -> None:
        super().__init__()
        if pieces < 2:
            raise ValueError(f"a curve needs at least 2 pieces, got {pieces}")
        self.weight, self.lr, self.lr_end = weight, lr, lr_end
        self.rises = nn.Parameter(torch.zeros(pieces))

    def forward(self, image: Tensor, frame: Frame) -> Tensor:
        shares = self.rises.softmax(0)
        nodes = torch.cat((shares.new_zeros(1), shares.cumsum(0)))
        bend = nodes - torch.linspace(0.0, 1.0, len(nodes), dtype=nodes.dtype, device=nodes.device)
        curve = torch.stack((torch.zeros_like(bend), bend), 1)
        return corrected(image.reshape(len(image), -1, 1), curve).view_as(image)  # each channel by itself

    def penalty(self) -> Tensor:
        logarithms = math.log(len(self.rises)) + self.rises.log_softmax(0)  # of slopes, which may underflow
        return logarithms.square().mean()

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"tone": {"pieces": len(self.rises), "monotone": True}}
