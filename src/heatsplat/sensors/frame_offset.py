"""Drift of the detector: a level, and if asked for a gain, that changes from image to image while the scene stays put."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import SHARE_OF_RANGE, Course, Frame, SceneData
from heatsplat.same_bits import everywhere
from heatsplat.sensors.per_frame import PerFrame


class FrameOffset(PerFrame):
    """I (1 + g_f) + o_f with one offset o_f, and one gain g_f where they are asked for, per training image.

    What all images share belongs to the scene: offsets and gains have mean zero over the training images. An image that
    was not trained on gets what lies between its neighbours in time (in frame number where there is no time), linearly,
    and beyond the first and the last what they have.

    Args:
        offset_max: bound of |o_f| in image units before the mean is taken away.
        gain_max: bound of |g_f| likewise; 0 leaves gains out.
        weight: of the penalty mean o² + mean g².
        lr, lr_end: learning rate and the factor on it at the end of the run.

    Raises:
        ValueError: a bound is out of its range.
    """

    def __init__(
        self,
        offset_max: float = 0.25,
        gain_max: float = 0.0,
        weight: float = 1e-3,
        lr: float = 0.01,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__()
        if offset_max <= 0 or not 0 <= gain_max < 1:
            raise ValueError(f"offset_max must be positive and gain_max lie in [0, 1), got {offset_max} and {gain_max}")
        self.offset_max, self.gain_max = offset_max, gain_max
        self.weight, self.lr, self.lr_end = weight, lr, lr_end
        self.raw_offset = nn.Parameter(torch.zeros(0))
        self.raw_gain = nn.Parameter(torch.zeros(0)) if gain_max > 0 else None

    def prepare(self, scene: SceneData, modality: str = "thermal") -> None:
        super().prepare(scene, modality)
        self.raw_offset = nn.Parameter(torch.zeros(len(self.moments)))
        if self.raw_gain is not None:
            self.raw_gain = nn.Parameter(torch.zeros(len(self.moments)))

    def forward(self, image: Tensor, frame: Frame) -> Tensor:
        offset = everywhere(self.at(self.offsets(), frame), image)
        if self.raw_gain is None:
            return image + offset
        return image + (image * everywhere(self.at(self.gains(), frame), image) + offset)

    def offsets(self) -> Tensor:
        """o of the training images in order of time, [F] in image units, with mean zero."""
        return _bounded(self.raw_offset, self.offset_max)

    def gains(self) -> Tensor:
        """g of the training images in order of time, [F], with mean zero; empty without gains."""
        return self.raw_offset.new_zeros(0) if self.raw_gain is None else _bounded(self.raw_gain, self.gain_max)

    def penalty(self) -> Tensor:
        penalty = self.offsets().square().mean()
        if self.raw_gain is not None:
            penalty = penalty + self.gains().square().mean()
        return penalty

    @torch.no_grad()
    def courses(self) -> list[Course]:
        if not self.timed:
            return []
        times = self.moments.tolist()
        found = [Course("drift of the camera: offset", times, self.offsets().tolist(), SHARE_OF_RANGE)]
        if self.raw_gain is not None:
            found.append(Course("drift of the camera: gain", times, self.gains().tolist(), "share"))
        return found

    def effects(self) -> dict[str, dict[str, Any]]:
        learned = "offset" if self.raw_gain is None else "offset and gain"
        return {"frame_offset": {"per_frame": learned, "frames": len(self.raw_offset)}}


def _bounded(raw: Tensor, bound: float) -> Tensor:
    values = bound * raw.tanh()
    return values - values.mean()
