"""Along each pixel of a depth map: how far its surface is, and at which angle it is seen."""

from __future__ import annotations

import torch
from scipy.ndimage import correlate1d
from torch import Tensor

from heatsplat.contracts import Camera

# A plane is fitted over the shorter side of the image / REACH to either side: depth maps of Gaussians are rough.
REACH = 20
LEAST = 3  # pixels to either side, in small images
BREAK = 0.05  # of 1 / depth, root mean square from that plane: what bends more has an edge in it


def rays(camera: Camera) -> Tensor:
    """Points [H, W, 3] of camera z 1 on the lines of sight through the middles of pixels, in the camera's frame, float64."""
    rows, columns = torch.meshgrid(
        torch.arange(camera.height, dtype=torch.float64), torch.arange(camera.width, dtype=torch.float64), indexing="ij"
    )
    pixels = torch.stack([columns + 0.5, rows + 0.5, torch.ones_like(rows)], dim=-1)
    return pixels @ torch.linalg.inv(camera.K).T


def distances(camera: Camera, depth: Tensor) -> Tensor:
    """Distances [H, W] from the camera's centre of what has a camera z [H, W]; infinite where there is no surface."""
    return depth.double() * rays(camera).norm(dim=-1)


def cosines(camera: Camera, depth: Tensor) -> Tensor:
    """Cosine [H, W] of the angle between the line of sight and the surface's normal, in [0, 1]; NaN where it is not known
    (``normals``)."""
    sight = rays(camera)
    return (normals(camera, depth) * sight).sum(-1).div(sight.norm(dim=-1)).clamp(0.0, 1.0)


def normals(camera: Camera, depth: Tensor) -> Tensor:
    """Normals [H, W, 3] of length 1 in the camera's frame, away from it, float64; NaN where they are not known.

    Those of ``planes`` over windows as large as depth maps of Gaussians are rough.

    Args:
        depth: [H, W] camera z, infinite where there is no surface.
    """
    found = planes(camera, depth, max(LEAST, min(depth.shape) // REACH), BREAK)
    return found / found.norm(dim=-1, keepdim=True)


def planes(camera: Camera, depth: Tensor, reach: int, flat: float) -> Tensor:
    """The planes n x = 1 that a depth map is made of, n [H, W, 3] in the camera's frame, away from it, float64; NaN where there
    is none.

    One over the depth is linear over the image of a plane, 1/z = n r for the ray r of a pixel; so n is fitted to it by least
    squares over a window. Where the window has an edge or an open pixel, or leaves the image, there is no plane.

    Args:
        depth: [H, W] camera z, infinite where there is no surface.
        reach: pixels of the window to either side.
        flat: of 1 / depth, root mean square from the plane, above which a window has an edge in it.
    """
    found = torch.full((*depth.shape, 3), torch.nan, dtype=torch.float64)
    if min(depth.shape) <= 2 * reach:
        return found
    steps = torch.arange(-reach, reach + 1, dtype=torch.float64)
    ones, inverse = torch.ones_like(steps), 1.0 / depth.double()

    def sums(image: Tensor, rows: Tensor, columns: Tensor) -> Tensor:
        """Sums over windows, weighted by rows and columns."""
        # Of a float64 image torch's convolution copies out every window first.
        down = correlate1d(image.numpy(), rows.numpy(), axis=0, mode="constant")
        return torch.from_numpy(correlate1d(down, columns.numpy(), axis=1, mode="constant"))[inner]

    inner = (slice(reach, -reach), slice(reach, -reach))
    count, spread = len(steps) ** 2, len(steps) * steps.square().sum()
    mean = sums(inverse, ones, ones) / count
    down, right = sums(inverse, steps, ones) / spread, sums(inverse, ones, steps) / spread  # slopes per pixel
    rest = (
        sums(inverse.square(), ones, ones) / count - mean.square() - (down.square() + right.square()) * spread / count
    )
    sight = rays(camera)[inner]
    # Slopes by X and Y of the ray (X, Y, 1), and what is left for the 1.
    normal = torch.stack([right * camera.K[0, 0], down * camera.K[1, 1], mean], dim=-1).double()
    normal[..., 2] -= (normal[..., :2] * sight[..., :2]).sum(-1)
    whole = sums(inverse.gt(0).double(), ones, ones) > count - 0.5
    known = whole & (rest.clamp(min=0.0).sqrt() < flat * mean)
    found[inner] = normal.where(known[..., None], torch.nan)
    return found
