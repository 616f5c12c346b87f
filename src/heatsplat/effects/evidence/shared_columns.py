"""Columns [P, F, c] of what all points share: one number of an effect times one column is what it adds to the values.

What multiplies an image takes that image, [P, F]: the points' own part and what earlier stages of the camera added.
"""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.effects.observations import Tracks


def frame_offset(image: Tensor, tracks: Tracks) -> Tensor:
    """An offset for each frame."""
    return torch.eye(image.shape[1], dtype=image.dtype).expand(len(image), -1, -1)


def agc(image: Tensor, tracks: Tracks) -> Tensor:
    """A gain for each frame."""
    return image[..., None] * frame_offset(image, tracks)


def vignetting(image: Tensor, tracks: Tracks) -> Tensor:
    """A gain that goes with the second and the fourth power of the distance from the middle of the image."""
    r2 = tracks.radii
    return torch.stack([r2, r2**2], 2) * image[..., None]


def fixed_pattern(image: Tensor, tracks: Tracks, nodes: int) -> Tensor:
    """Offsets and gains on a grid of ``nodes`` by ``nodes`` over the image, straight in between."""
    along = (tracks.positions.clamp(-1, 1) + 1) * (0.5 * (nodes - 1))
    hats = (1.0 - (along[..., None] - torch.arange(nodes, dtype=image.dtype)).abs()).clamp_min(0.0)
    places = (hats[..., 0, :, None] * hats[..., 1, None, :]).flatten(2)
    return torch.cat([places, places * image[..., None]], 2)


def reflection(tracks: Tracks, normals: Tensor) -> Tensor:
    """Harmonics to degree 2 of the direction that a mirror shows; ``normals`` [P, 3]."""
    out, normals = tracks.directions, normals[:, None]
    x, y, z = (2.0 * (out * normals).sum(2, keepdim=True) * normals - out).unbind(2)
    return torch.stack([x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1], 2)


def tone(image: Tensor, offset: Tensor) -> Tensor:
    """A curve T turns an offset o of the level x into T'(x) o: what it bends goes with o times x and x²."""
    return torch.cat([offset[..., None] * image[..., None], offset[..., None] * image[..., None] ** 2], 2)
