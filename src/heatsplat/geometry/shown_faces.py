"""Which triangle of a mesh each pixel of a camera shows."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import Camera
from heatsplat.geometry.fusion import Surface
from heatsplat.geometry.projection import to_camera, to_pixels

APART = 0.7  # pixels between places of a triangle that are looked up
AT_ONCE = 2**21  # such places


def shown_faces(camera: Camera, surface: Surface, two_sided: bool = False) -> Tensor:
    """The nearest triangle in each pixel [H, W], int64; -1 where there is none.

    Triangles are looked up at places less than a pixel apart; those that are not wholly before the camera are left out.

    Args:
        two_sided: also those that are seen from inside.
    """
    local = to_camera(surface.vertices, camera.viewmat)
    flat = torch.cat([to_pixels(local, camera.K), local[:, 2:]], dim=1).numpy()[surface.faces.numpy()]  # [F, 3, 3]
    first, second = flat[:, 1, :2] - flat[:, 0, :2], flat[:, 2, :2] - flat[:, 0, :2]
    turned = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]  # below 0: anticlockwise, as rows count downwards
    size = np.array([camera.width, camera.height])
    in_image = (flat[..., :2].max(1) >= 0).all(1) & (flat[..., :2].min(1) < size).all(1)
    kept = np.flatnonzero((flat[..., 2] > 0).all(1) & in_image & ((turned < 0) | two_sided))
    longest = np.max([np.linalg.norm(side, axis=1)[kept] for side in (first, second, second - first)], axis=0)
    steps = np.ceil(longest / APART).clip(1, 4 * max(camera.width, camera.height)).astype(np.int64)
    nearest = np.full(camera.width * camera.height, np.iinfo(np.uint64).max, dtype=np.uint64)
    for count in np.unique(steps):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        i, j = i[i + j <= count], j[i + j <= count]
        shares = np.stack([count - i - j, i, j], axis=1) / count
        faces = kept[steps == count]
        for some in np.array_split(faces, max(1, -(-len(faces) * len(shares) // AT_ONCE))):
            x, y, z = np.einsum("sk,fkc->cfs", shares, flat[some])
            column, row = np.floor(x), np.floor(y)
            inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
            pixel = (row[inside] * camera.width + column[inside]).astype(np.int64)
            # Depths above 0 have the order of their bits; below them stands the face.
            depth = z[inside].astype(np.float32).view(np.uint32).astype(np.uint64)
            face = np.broadcast_to(some[:, None], inside.shape)[inside].astype(np.uint64)
            np.minimum.at(nearest, pixel, (depth << np.uint64(32)) | face)
    found = np.where(nearest == np.iinfo(np.uint64).max, -1, (nearest & np.uint64(0xFFFFFFFF)).astype(np.int64))
    return torch.from_numpy(found.reshape(camera.height, camera.width))
