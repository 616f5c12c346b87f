"""Rotations as quaternions wxyz and as matrices; pure functions, differentiable, any leading dimensions."""

from __future__ import annotations

import torch
from torch import Tensor


def normalised(quats: Tensor) -> Tensor:
    """Unit quaternions [..., 4] of the same rotations.

    **Convention:** any length but zero; a zero quaternion gives zeros (it is no rotation, callers must leave it out).
    Dividing by the largest component first keeps lengths from 1e-37 to 1e38 in float32: squares neither vanish nor
    overflow. The rotation does not depend on that factor, so its gradient is left out exactly.
    """
    largest = quats.detach().abs().amax(dim=-1, keepdim=True)
    scaled = quats / torch.where(largest > 0, largest, 1.0)
    length = scaled.square().sum(dim=-1, keepdim=True)
    return scaled * torch.where(length > 0, length, 1.0).rsqrt()


def quats_to_matrices(quats: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of quaternions [..., 4] wxyz of any length but zero."""
    w, x, y, z = normalised(quats).unbind(-1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def reflected(directions: Tensor, normals: Tensor) -> Tensor:
    """Directions [..., 3] in which those that meet a mirror go on, d - 2 (d · n) n.

    Args:
        directions: [..., 3] towards the mirror, of any length.
        normals: [..., 3] unit normals of the mirror, on either side.
    """
    return directions - 2.0 * (directions * normals).sum(-1, keepdim=True) * normals


def matrices_to_quats(matrices: Tensor) -> Tensor:
    """Unit quaternions [..., 4] wxyz, w >= 0, of rotation matrices [..., 3, 3].

    Four times the outer product of a unit quaternion with itself is linear in the entries of its matrix; the row of the
    largest diagonal element is divided by its length, which is never small (at least 1 of 4; Markley 2008).
    """
    m = matrices
    trace = m.diagonal(dim1=-2, dim2=-1).sum(-1)
    a, b, c = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    xx, yy, zz = (1 + 2 * m[..., i, i] - trace for i in range(3))
    outer = torch.stack(
        [
            torch.stack([1 + trace, a, b, c], dim=-1),
            torch.stack([a, xx, xy, xz], dim=-1),
            torch.stack([b, xy, yy, yz], dim=-1),
            torch.stack([c, xz, yz, zz], dim=-1),
        ],
        dim=-2,
    )
    best = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)
    row = outer.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    quats = normalised(row)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def slerp(start: Tensor, end: Tensor, fraction: Tensor | float) -> Tensor:
    """Unit quaternions [..., 4] on the shorter great arc from ``start`` (fraction 0) to ``end`` (fraction 1).

    **Convention:** constant angular speed in ``fraction`` [...], which broadcasts over the leading dimensions.
    """
    start, end = normalised(start), normalised(end)
    end = torch.where((start * end).sum(-1, keepdim=True) < 0, -end, end)
    fraction = torch.as_tensor(fraction, dtype=start.dtype, device=start.device)[..., None]
    # atan2 of the chord's halves is accurate at every angle; acos of the dot product is not near 0.
    angle = 2 * torch.atan2((end - start).norm(dim=-1, keepdim=True), (end + start).norm(dim=-1, keepdim=True))
    same = angle == 0  # any other angle, however small, is divided by without loss
    safe = torch.where(same, 1.0, angle)
    first = torch.where(same, 1 - fraction, torch.sin((1 - fraction) * safe) / torch.sin(safe))
    second = torch.where(same, fraction, torch.sin(fraction * safe) / torch.sin(safe))
    return normalised(first * start + second * end)
