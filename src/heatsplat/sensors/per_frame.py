"""Settings of the camera that change from image to image, and what they were for an image that was not trained on."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.contracts import Frame, SceneData
from heatsplat.sensors.base import SensorPart


class PerFrame(SensorPart):
    """A part with settings for each training image, kept in order of time (of frame number where there is no time).

    An image that was not trained on lies between its two neighbours in that order; beyond the first and the last it is
    where they are. A view that no one took has no number, and without a time it is in the middle of the record.
    """

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("moments", torch.zeros(0, dtype=torch.float64))  # of the training images, increasing
        self.register_buffer("frame_ids", torch.zeros(0, dtype=torch.int64))  # in the same order
        self.register_buffer("timed", torch.tensor(True))
        self._last_number = 0  # of the frames of the scene; views that no one took have higher ones

    def prepare(self, scene: SceneData, modality: str = "thermal") -> None:
        self.timed.fill_("time" in scene.metadata)
        self._last_number = max(frame.frame_id for frame in scene.frames)
        frames = sorted(scene.train.frames, key=lambda frame: (self._moment(frame), frame.frame_id))
        self.moments = torch.tensor([self._moment(frame) for frame in frames], dtype=torch.float64)
        self.frame_ids = torch.tensor([frame.frame_id for frame in frames])

    def trained_on(self, frame: Frame) -> bool:
        """Whether the image is one of those that have settings."""
        return bool((self.frame_ids == frame.frame_id).any())

    def at(self, values: Tensor, frame: Frame) -> Tensor:
        """What an image has of ``values`` [F, ...] of the training images in order, [...]: its own, or what lies between."""
        before, after, share = self._place(frame)
        return values[before] if share == 0 else torch.lerp(values[before], values[after], share)

    def _moment(self, frame: Frame) -> float:
        """What orders images: their time, or their number. In the middle of the record for a view without."""
        number = frame.frame_id if frame.frame_id <= self._last_number else None
        moment = frame.time_s if self.timed else number
        if moment is not None:
            return float(moment)
        return float(self.moments[0] + self.moments[-1]) / 2

    def _place(self, frame: Frame) -> tuple[int, int, float]:
        """Training images between which a frame lies, and how far from the first to the second."""
        own = (self.frame_ids == frame.frame_id).nonzero()
        if len(own):
            return int(own[0]), int(own[0]), 0.0
        moment = self._moment(frame)
        after = int(torch.searchsorted(self.moments, moment))
        if after in (0, len(self.moments)):
            end = min(after, len(self.moments) - 1)
            return end, end, 0.0
        earlier, later = self.moments[after - 1].item(), self.moments[after].item()
        return after - 1, after, (moment - earlier) / (later - earlier)
