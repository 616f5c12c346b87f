"""Parts that depend on how the image moves across the detector while it is recorded."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import Frame, SceneData, SceneError
from heatsplat.geometry.motion import screen_velocity, twists
from heatsplat.sensors.per_frame import PerFrame


class MovingPart(PerFrame):
    """A part that sees the image move: the camera's motion is that between training frames, the distance is the model's own.

    An image that was not trained on moves as its neighbours in time do.
    """

    needs_depth = True

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("twists", torch.zeros(0, 6, dtype=torch.float64))  # of the training images, in order

    def prepare(self, scene: SceneData, modality: str = "thermal") -> None:
        super().prepare(scene, modality)
        if not self.timed:
            raise SceneError(
                f"scene '{scene.name}' has training views without a time, so nothing is known of how fast the camera moves: "
                f"give the frames times, or leave {type(self).__name__} out"
            )
        cameras = {frame.frame_id: frame.camera for frame in scene.train.frames}
        viewmats = torch.stack([cameras[number].viewmat for number in self.frame_ids.tolist()])
        self.twists = twists(viewmats, self.moments)

    @abstractmethod
    def forward(self, image: Tensor, frame: Frame, depth: Tensor) -> Tensor:
        """The image that the camera records of the clean ``image`` [H, W, C].

        Args:
            depth: [H, W] of what is seen (camera z); infinite where nothing is.
        """

    def velocity(self, frame: Frame, depth: Tensor) -> Tensor:
        """How fast what is seen moves through the image, [H, W, 2] in its pixels per second."""
        height, width = depth.shape
        y, x = torch.meshgrid(
            torch.arange(height, dtype=depth.dtype, device=depth.device),
            torch.arange(width, dtype=depth.dtype, device=depth.device),
            indexing="ij",
        )
        twist = self.at(self.twists, frame).to(depth)
        K = frame.camera.resized(width, height).K.to(depth)
        return screen_velocity(torch.stack([x, y], -1) + 0.5, 1.0 / depth, K, twist)


def displaced(image: Tensor, offsets: Tensor) -> Tensor:
    """What an image [H, W, C] shows so many pixels (x, y) away from every pixel, [K, H, W, C] for ``offsets`` [K, H, W, 2].

    Bilinear between pixel centres; beyond the border lies the border. Differentiable in both.
    """
    height, width = image.shape[:2]
    size = offsets.new_tensor([width, height])
    y, x = torch.meshgrid(torch.arange(height).to(offsets), torch.arange(width).to(offsets), indexing="ij")
    grid = (torch.stack([x, y], -1) + 0.5 + offsets) * (2.0 / size) - 1.0
    planes = image.permute(2, 0, 1).expand(len(offsets), -1, -1, -1)
    found = functional.grid_sample(planes, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return found.permute(0, 2, 3, 1)
