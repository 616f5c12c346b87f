"""From the world to pixels: points, Gaussians and the pose of a camera; pure and differentiable functions.

Conventions: OpenCV camera axes (x right, y down, z forward), ``viewmat`` [4, 4] maps world to camera, ``K`` [3, 3] in
pixels without skew, pixel centres at +0.5.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from heatsplat.geometry.rotations import quats_to_matrices


class ScreenGaussians(NamedTuple):
    """Gaussians as an image sees them, n of them.

    Args:
        means: [n, 2] centres in pixels.
        depths: [n] camera z.
        variances: [n, 2] diagonal of the blurred screen covariance, in pixels².
        whitening: [n, 3] numbers (p, q, r) such that for an offset (dx, dy) in pixels from the centre
            u = (p (dx - q dy), r dy) has the Mahalanobis length: u·u = (dx, dy) covariance⁻¹ (dx, dy)ᵀ.
        compensation: [n] square root of det(covariance) / det(blurred covariance), in [0, 1].
    """

    means: Tensor
    depths: Tensor
    variances: Tensor
    whitening: Tensor
    compensation: Tensor


def to_camera(points: Tensor, viewmat: Tensor) -> Tensor:
    """Points in camera axes [..., 3] of points in the world [..., 3]."""
    return points @ viewmat[:3, :3].T + viewmat[:3, 3]


def to_world(points: Tensor, viewmat: Tensor) -> Tensor:
    """Points in the world [..., 3] of points in camera axes [..., 3]."""
    return (points - viewmat[:3, 3]) @ viewmat[:3, :3]


def eyes(viewmats: Tensor) -> Tensor:
    """Positions [n, 3] of cameras in the world, of their world-to-camera matrices [n, 4, 4]."""
    return -(viewmats[:, :3, :3].mT @ viewmats[:, :3, 3:])[..., 0]


def view_matrix(rotation: Tensor, eye: Tensor) -> Tensor:
    """World-to-camera matrix [4, 4] of a camera at ``eye`` [3] whose axes are the rows of ``rotation`` [3, 3]."""
    viewmat = torch.eye(4, dtype=rotation.dtype, device=rotation.device)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ eye
    return viewmat


def to_pixels(points: Tensor, K: Tensor) -> Tensor:
    """Pixel coordinates [..., 2] of points in camera axes [..., 3] whose z is not zero."""
    focal = torch.stack([K[0, 0], K[1, 1]])
    return points[..., :2] / points[..., 2:] * focal + K[:2, 2]


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """World-to-camera matrix [4, 4] of a camera at ``eye`` that looks at ``target`` with ``up`` upwards in the image.

    Args:
        eye, target: [3] positions in the world.
        up: [3] direction; its part along the line of sight does not matter.

    Raises:
        ValueError: eye and target coincide, or up is along the line of sight.
    """
    forward = target - eye
    right = torch.linalg.cross(forward, up)
    if not right.norm() > 1e-9 * forward.norm() * up.norm():
        raise ValueError(
            f"look_at needs a target away from the eye and an up direction across the line of sight, got eye "
            f"{eye.tolist()}, target {target.tolist()}, up {up.tolist()}"
        )
    forward, right = forward / forward.norm(), right / right.norm()
    return view_matrix(torch.stack([right, torch.linalg.cross(forward, right), forward]), eye)


def clamped_slopes(points: Tensor, K: Tensor, width: int, height: int, margin: float) -> Tensor:
    """x/z and y/z [n, 2] of points in camera axes [n, 3], held within the image's field of view and a margin.

    **Convention:** the margin is a fraction of half the field of view, beyond the image border on each side. Outside of
    it the perspective is too curved for a Jacobian (3DGS and gsplat clamp likewise); the gradient is zero there.
    """
    focal = torch.stack([K[0, 0], K[1, 1]])
    size = torch.tensor([width, height], dtype=points.dtype, device=points.device)
    beyond = margin * 0.5 * size / focal
    low, high = -K[:2, 2] / focal - beyond, (size - K[:2, 2]) / focal + beyond
    return torch.clamp(points[:, :2] / points[:, 2:], low, high)


def project_gaussians(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    eps2d: float,
    margin: float,
) -> ScreenGaussians:
    """Screen Gaussians of n Gaussians in front of the camera: J W Σ Wᵀ Jᵀ + eps2d I, in a form that does not cancel.

    The rows of J W R diag(s) are two vectors u and w of three numbers each. Their inner products are the covariance,
    and |u x w|² is its determinant (Cauchy-Binet), a sum of squares where u·u w·w - (u·w)² would cancel for needles.
    That cross product is itself known in closed form, because cofactors multiply:

        u x w = (s_y s_z, s_z s_x, s_x s_y) * Rᵀ cof(W)ᵀ (j_x x j_y),    j_x x j_y = fx fy / z² (x/z, y/z, 1)

    so that needles and flat discs keep their digits. Nothing here divides by a scale.

    Args:
        means, quats, scales: [n, 3], [n, 4] wxyz and not zero, [n, 3] semi-axes; camera z must not be zero.
        viewmat, K: [4, 4] and [3, 3].
        width, height: image size in pixels; it bounds the Jacobian.
        eps2d: pixels² added to both variances.
        margin: see ``clamped_slopes``.
    """
    view = viewmat[:3, :3]
    points = to_camera(means, viewmat)
    z = points[:, 2]
    slopes = clamped_slopes(points, K, width, height, margin)
    fx, fy = K[0, 0] / z, K[1, 1] / z

    rotations = quats_to_matrices(quats)
    axes = view @ rotations * scales[:, None, :]
    u = fx[:, None] * (axes[:, 0] - slopes[:, :1] * axes[:, 2])
    w = fy[:, None] * (axes[:, 1] - slopes[:, 1:] * axes[:, 2])

    cofactors = torch.linalg.cross(view[[1, 2, 0]], view[[2, 0, 1]])
    normals = torch.cat([slopes, torch.ones_like(slopes[:, :1])], dim=1) @ cofactors
    areas = scales[:, [1, 2, 0]] * scales[:, [2, 0, 1]]
    cross = (fx * fy)[:, None] * areas * torch.einsum("ni,nij->nj", normals, rotations)

    plain_xx, plain_yy = u.square().sum(1), w.square().sum(1)
    xx, yy, xy = plain_xx + eps2d, plain_yy + eps2d, (u * w).sum(1)
    # Everything is divided by yy before it is squared or summed: determinants of large Gaussians overflow in float32.
    cross = cross / yy.sqrt()[:, None]
    remainder = cross.square().sum(1) + eps2d * (plain_xx / yy + 1)  # det / yy, the variance of x given y
    whitening = torch.stack([remainder.rsqrt(), xy / yy, yy.rsqrt()], dim=1)
    # norm() has gradient zero at zero, where the square root has none (a disc seen from its edge).
    compensation = cross.norm(dim=1) * remainder.rsqrt()
    return ScreenGaussians(to_pixels(points, K), z, torch.stack([xx, yy], dim=1), whitening, compensation)
