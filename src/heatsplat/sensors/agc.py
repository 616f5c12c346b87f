"""Automatic gain control: a camera that stretches the contrast of every image as it likes."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import Frame, SceneData
from heatsplat.same_bits import everywhere, sigmoid
from heatsplat.sensors.per_frame import PerFrame

EPSILON = 1e-4  # images are kept this far from 0 and 1 under the logit, which bounds its slope by 1e4


class GainControl(PerFrame):
    """sigmoid(s logit(I) + t) with one s and t per training image: a monotone stretch of contrast (SupIR-GS, Eq. 5).

    A stretch common to all images belongs to the scene: log s and t have mean zero over the training images. An image
    that was not trained on has no s and t of its own: it is left as it is, or has what lies between its neighbours'.

    It is computed as I + [sigmoid(s logit(Ĩ) + t) - sigmoid(logit(Ĩ))], Ĩ being I clipped to [ε, 1 - ε]. That is the
    same where nothing is clipped, exactly I for s = 1 and t = 0, and keeps a gradient where something is.

    Args:
        stretch_max: bound of s and 1/s before the mean is taken away; larger than 1.
        shift_max: bound of |t| before the mean is taken away.
        between: False leaves images that were not trained on as they are; True gives them log s and t between those of
            their neighbours in time, linearly, as where the stretch follows what is seen and not a switch.
        weight: of the penalty mean of (s - 1)² + t².
        lr, lr_end: learning rate and the factor on it at the end of the run.
    """

    def __init__(
        self,
        stretch_max: float = 2.0,
        shift_max: float = 1.0,
        between: bool = False,
        weight: float = 5e-4,
        lr: float = 0.03,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__()
        if stretch_max <= 1 or shift_max < 0:
            raise ValueError(
                f"stretch_max must be above 1 and shift_max not negative, got {stretch_max} and {shift_max}"
            )
        self.between, self.weight, self.lr, self.lr_end = between, weight, lr, lr_end
        self.register_buffer("bounds", torch.tensor([math.log(stretch_max), shift_max]))
        self.raw = nn.Parameter(torch.zeros(0, 2))

    def prepare(self, scene: SceneData, modality: str = "thermal") -> None:
        super().prepare(scene, modality)
        self.raw = nn.Parameter(torch.zeros(len(self.frame_ids), 2))

    def forward(self, image: Tensor, frame: Frame) -> Tensor:
        if not (self.between or self.trained_on(frame)):
            return image
        log_stretch, shift = self.at(self.settings(), frame)
        logits = torch.logit(image.clamp(EPSILON, 1 - EPSILON))
        stretch, shift = everywhere(log_stretch.exp(), image), everywhere(shift, image)
        return image + (sigmoid(stretch * logits + shift) - sigmoid(logits))

    def settings(self) -> Tensor:
        """log s and t of the training images in order of time, [F, 2], each with mean zero."""
        values = self.bounds * self.raw.tanh()
        return values - values.mean(0)

    def penalty(self) -> Tensor:
        log_stretch, shift = self.settings().unbind(1)
        return (log_stretch.expm1().square() + shift.square()).mean()

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"agc": {"frames": len(self.raw)}}
