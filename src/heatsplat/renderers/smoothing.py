"""What is done to Gaussians before they are projected: nothing, or a filter in space that fits the cameras."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData, SceneError
from heatsplat.geometry.smoothing import kept_opacity, sampling_intervals, smoothed


class Smoothing(nn.Module):
    """Leaves Gaussians as they are: nothing is stored and nothing is computed. Filters in space are subclasses.

    Attributes:
        changes: whether it does anything to Gaussians.
    """

    changes = False

    def prepare(self, scene: SceneData, means: Tensor) -> None:
        """Takes what it needs from the scene and from the centres [N, 3] of the Gaussians before the first step."""

    def follow(self, means: Tensor, step: int, end: int, changed: bool) -> None:
        """Told after every training step of ``end``: centres [N, 3], and whether Gaussians came, went or were reset in it."""

    def forward(self, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
        """Semi-axes [N, 3] and opacities [M, N] that are rendered."""
        return scales, opacities

    def kept_opacity(self, means: Tensor, scales: Tensor) -> Tensor | None:
        """Factor on the opacity of Gaussians of these centres and semi-axes, [N]; None where all is 1."""
        return None


class SamplingFilter(Smoothing):
    """The 3D smoothing filter of Mip-Splatting: no Gaussian is finer than the training cameras could have sampled it.

    Every Gaussian is convolved with an isotropic one of variance ``variance`` pixels² of the training camera that is
    nearest to it; its mass is kept. The widths stand still between two looks at the cameras. They are a buffer, so that
    a checkpoint has those that it was written with.

    Args:
        variance: s of the paper, in squared distances between samples.
        every: steps between two looks at the cameras, when no Gaussian comes or goes; none in the last ``every`` steps.
        near: a camera sees Gaussians whose z is above this, world units.
        margin: and that project at most this share of the image's width or height beyond its border.

    Raises:
        ValueError: an option is out of its range.
    """

    changes = True

    def __init__(self, variance: float = 0.2, every: int = 100, near: float = 0.2, margin: float = 0.15) -> None:
        super().__init__()
        if not (variance > 0 and every >= 1 and near >= 0 and margin >= 0):
            raise ValueError(
                "smoothing.variance must be positive, every at least 1, near and margin not negative, got "
                f"{variance}, {every}, {near} and {margin}"
            )
        self.variance, self.every, self.near, self.margin = variance, every, near, margin
        self._cameras = ()
        self.register_buffer("widths", torch.zeros(0))

    def prepare(self, scene: SceneData, means: Tensor) -> None:
        self._cameras = tuple(frame.camera for frame in scene.train.frames)
        try:
            self.widths = self._widths(means)
        except ValueError as error:
            raise SceneError(f"smoothing.near={self.near:g} does not fit scene '{scene.name}': {error}") from error

    def follow(self, means: Tensor, step: int, end: int, changed: bool) -> None:
        due = (step + 1) % self.every == 0 and step + 1 < end - self.every
        if changed or due:
            self.widths = self._widths(means)

    def forward(self, scales: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
        return smoothed(scales, opacities, self.widths)

    def kept_opacity(self, means: Tensor, scales: Tensor) -> Tensor:
        return kept_opacity(scales, self._widths(means))

    @torch.no_grad()
    def _widths(self, means: Tensor) -> Tensor:
        """Standard deviations of the filter at centres [N, 3], world units, [N]."""
        return math.sqrt(self.variance) * sampling_intervals(means, self._cameras, self.near, self.margin)
