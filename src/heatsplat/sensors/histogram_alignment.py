"""Images whose histograms drift, brought to one histogram and back ("Thermal is Always Wild", CVPR 2026)."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import Frame, SceneData, SceneError, quantile
from heatsplat.sensors.per_frame import PerFrame

LEAST_RISE = 1e-3  # between neighbouring quantiles, image units: maps stay reversible where an image is flat


class HistogramAlignment(PerFrame):
    """Carries the scene's histogram over to that of an image: quantile to quantile, straight in between.

    Splats live in images whose histograms are alike, as if every training image had been matched to their mean; the camera
    then shows them with the histogram of its own. Nothing is learned, and nothing is lost: the map rises everywhere. An
    image that was not trained on gets what lies between its neighbours, as its own histogram is not known.

    **Convention:** one map serves all channels, whose values make one histogram. Images that see different things have
    different histograms, too. Alignment of all of the difference takes those for drift; ``strength`` below 1 takes part of it,
    and of a scene that changes it hides the change.

    Args:
        quantiles: nodes of the map; at least 2.
        strength: share of the difference of histograms that is taken for the camera's, 0 to 1.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(self, quantiles: int = 16, strength: float = 1.0) -> None:
        super().__init__()
        if quantiles < 2 or not 0 <= strength <= 1:
            raise ValueError(f"quantiles must be at least 2 and strength in [0, 1], got {quantiles} and {strength}")
        self.count, self.strength = quantiles, strength
        self.register_buffer("own", torch.zeros(0, quantiles))  # of the training images in order of time
        self.register_buffer("shared", torch.zeros(quantiles))

    def prepare(self, scene: SceneData, modality: str = "thermal") -> None:
        super().prepare(scene, modality)
        shares = torch.linspace(0.0, 1.0, self.count)
        found = {}
        for view in scene.train:
            values = view.image(modality)
            # Pixels that were cut off at an end of their span keep their place among the others.
            values = values if view.mask is None else values[view.mask]
            unknown = not values.numel()  # its mask leaves none: the shared histogram stands for its own
            found[view.frame.frame_id] = shares * torch.nan if unknown else quantile(values.flatten().float(), shares)
        rows = torch.stack([found[int(frame_id)] for frame_id in self.frame_ids])
        if rows.isnan().all():
            raise SceneError(f"masks leave no pixel of the training images of scene '{scene.name}'")
        shared = rows.nanmean(0)
        rows = torch.where(rows.isnan(), shared, rows)
        rows = shared + self.strength * (rows - shared)
        self.own = rows[:, :1] + _rising(rows - rows[:, :1])
        self.shared = shared[0] + _rising(shared - shared[0])

    def forward(self, image: Tensor, frame: Frame) -> Tensor:
        nodes = self.at(self.own, frame)
        piece = torch.searchsorted(self.shared, image.detach().contiguous()).clamp(1, self.count - 1) - 1
        slopes = nodes.diff() / self.shared.diff()
        return nodes[piece] + slopes[piece] * (image - self.shared[piece])

    def effects(self) -> dict[str, dict[str, Any]]:
        return {"frame_offset": {"histogram": self.count, "frames": len(self.frame_ids)}}


def _rising(heights: Tensor) -> Tensor:
    """Heights [..., Q] of which none lies less than ``LEAST_RISE`` above the one before."""
    floor = LEAST_RISE * torch.arange(heights.shape[-1], dtype=heights.dtype)
    return (heights - floor).cummax(-1).values + floor
