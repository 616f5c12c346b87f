"""Rolling read-out: the rows of a microbolometer are read one after the other, and the camera moves meanwhile."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import Frame
from heatsplat.sensors.moving import MovingPart, displaced


class RollingReadout(MovingPart):
    """Row r of H is read δ = ((r + 1/2) / H - 1/2) T after the moment of the pose: it shows I(p - v δ) at a pixel p.

    v is the velocity of the image there. That is the pose of each row to first order (Forssén and Ringaby, CVPR 2010, have
    the geometry). T > 0 reads from top to bottom, T < 0 from bottom to top. Rows are those of the image as it is loaded: of
    an image that was turned upright, or cut, T is what its rows take.

    Args:
        readout_max: bound of |T| in seconds.
        weight: of the penalty (T / readout_max)².
        lr, lr_end: learning rate and the factor on it at the end of the run.

    Raises:
        ValueError: the bound is not positive.
    """

    def __init__(self, readout_max: float = 0.05, weight: float = 1e-6, lr: float = 0.01, lr_end: float = 0.1) -> None:
        super().__init__()
        if not readout_max > 0:
            raise ValueError(f"readout_max is a time in seconds and must be positive, got {readout_max}")
        self.readout_max, self.weight, self.lr, self.lr_end = readout_max, weight, lr, lr_end
        self.raw_readout = nn.Parameter(torch.zeros(()))

    def forward(self, image: Tensor, frame: Frame, depth: Tensor) -> Tensor:
        height = len(image)
        delays = ((torch.arange(height).to(image) + 0.5) / height - 0.5) * self.readout().to(image)
        return displaced(image, -(self.velocity(frame, depth).to(image) * delays[:, None, None])[None])[0]

    def readout(self) -> Tensor:
        """T in seconds, []."""
        return self.readout_max * self.raw_readout.tanh()

    def penalty(self) -> Tensor:
        return (self.readout() / self.readout_max).square()

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"rolling_readout": {"readout_ms": 1e3 * self.readout().item()}}
