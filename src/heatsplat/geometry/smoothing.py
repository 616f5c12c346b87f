"""How finely cameras sample the world at a point, and Gaussians widened to what such samples can show (Mip-Splatting)."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from heatsplat.contracts import Camera


def sampling_intervals(points: Tensor, cameras: Iterable[Camera], near: float = 0.2, margin: float = 0.15) -> Tensor:
    """Distance in the world between neighbouring pixels at each point [N], in the camera that samples it most finely.

    It is the least camera z over the cameras that see the point, divided by the largest focal length of all cameras: the
    inverse of the maximal sampling rate (Mip-Splatting, Eq. 6, as its code has it). Points that no camera sees get the
    largest z of the others.

    Args:
        points: [N, 3] in the world.
        cameras: those that sampled the scene, such as all training cameras.
        near: a camera sees points whose z is above this, world units.
        margin: and that project into its image or beyond the border by at most this share of width or height.

    Raises:
        ValueError: no camera sees any of the points.
    """
    least = points.new_full((len(points),), torch.inf)
    columns, focal = points.T.contiguous(), 0.0  # of points in rows every step below would take four times as long
    for camera in cameras:
        viewmat, K = camera.viewmat.to(points), camera.K.tolist()
        *sides, z = torch.addmm(viewmat[:3, 3:], viewmat[:3, :3], columns)
        seen = z > near
        for k, (side, size) in enumerate(zip(sides, (camera.width, camera.height), strict=True)):
            pixels = (side / z).mul_(K[k][k]).add_(K[k][2])  # nonsense where z is not positive, and not looked at there
            seen &= (pixels >= -margin * size) & (pixels <= (1 + margin) * size)
        least = torch.minimum(least, z.masked_fill_(~seen, torch.inf))
        focal = max(focal, K[0][0], K[1][1])
    seen = least.isfinite()
    if not seen.any():
        raise ValueError(
            f"none of {len(points)} points is seen by a camera from more than {near:g} world units away; lower 'near', or "
            "check that points and cameras are in the same world"
        )
    return torch.where(seen, least, least[seen].max()) / focal


def smoothed(scales: Tensor, opacities: Tensor, widths: Tensor) -> tuple[Tensor, Tensor]:
    """Semi-axes and opacities of Gaussians after convolution with isotropic ones of standard deviation ``widths``.

    The semi-axes become sqrt(s² + f²) and the opacity is multiplied by the product of s / sqrt(s² + f²) over the axes,
    so that a Gaussian keeps its mass (Mip-Splatting, Eq. 9). No square is formed: hypot keeps the digits of axes whose
    square, let alone the product of three, leaves the range of floats.

    Args:
        scales: [N, 3] semi-axes s.
        opacities: [..., N], any number of modalities.
        widths: [N] standard deviations f; where it is 0, a scale must not be.
    """
    wide = torch.hypot(scales, widths[:, None].expand_as(scales))
    return wide, opacities * kept_opacity(scales, widths)


def kept_opacity(scales: Tensor, widths: Tensor) -> Tensor:
    """The factor on opacities in ``smoothed``, [N] in [0, 1]."""
    ratios = scales / torch.hypot(scales, widths[:, None].expand_as(scales))
    return ratios[:, 0] * ratios[:, 1] * ratios[:, 2]
