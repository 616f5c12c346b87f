"""How strong the effects of a drawn scene are: by how much its images would differ without each, beside the camera's noise."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from benchmarks.without import scene_of, without
from heatsplat.datamodules.synthetic import Synthetic
from heatsplat.datamodules.synthetic_scene.film import film
from heatsplat.effects.observations import Tracks, between, observe


def strengths(recorded: Synthetic) -> dict[str, float]:
    """Root mean square of what each effect that a drawn scene shows changes in noise-free training images, in standard deviations
    of the noise of a pixel, by name.

    It is taken over the tracks of scene points that verdicts look at, beside a level for each point, which any model has; over
    all pixels where there are no tracks.
    """
    scene, preset = recorded.scene, recorded.drawn.preset
    seen = observe(scene)
    frames, bounds = [frame.frame_id for frame in seen.frames], scene.thermal_range

    def images(world) -> Tensor:
        """Noise-free training images [F, H, W] in the range of the record."""
        world.thermal_range = bounds
        celsius = film(world, recorded.size, recorded.scene_seed, noise_k=0.0).celsius[frames]
        return bounds.to_unit(torch.from_numpy(celsius).double()).clamp(0.0, 1.0)

    noise = math.hypot(recorded.noise_k / bounds.span_k, 1.0 / (2**recorded.bits - 1) / math.sqrt(12.0))
    there = images(scene_of(preset)) if preset.effects else None
    changes = {name: (there - images(without(preset, name))) / noise for name in sorted(preset.effects)}
    return {name: beside_levels(change, seen.tracks) for name, change in changes.items()}


def beside_levels(change: Tensor, tracks: Tracks | None) -> float:
    """Root mean square of a change of images [F, H, W] beside a level for each point; of all pixels without tracks."""
    if tracks is None:
        return float(change.square().mean().sqrt())
    found: Sequence[Tensor] = [
        between(image[..., None], places)[:, 0]
        for image, places in zip(change, tracks.positions.unbind(1), strict=True)
    ]
    values, weights = torch.stack(found, 1), tracks.weights
    counts = weights.sum(1, keepdim=True).clamp_min(1.0)
    left = (values - (values * weights).sum(1, keepdim=True) / counts) * weights
    return float((left.square().sum() / (counts - 1.0).sum().clamp_min(1.0)).sqrt())
