"""Real spherical harmonics of degree 0 to 3: a function of direction as a short sum."""

from __future__ import annotations

import torch
from torch import Tensor

MAX_DEGREE = 3
C0 = 0.28209479177387814  # 1 / (2 sqrt(pi)): the constant harmonic


def band_count(degree: int) -> int:
    """Number of harmonics up to and including ``degree``: 1, 4, 9 or 16.

    Raises:
        ValueError: the degree is not 0, 1, 2 or 3.
    """
    if degree not in range(MAX_DEGREE + 1):
        raise ValueError(f"spherical harmonics have degree 0 to {MAX_DEGREE} here, got {degree}")
    return (degree + 1) ** 2


def unit(directions: Tensor) -> Tensor:
    """Directions at unit length, [n, 3]; a direction of zero length stays zero, with zero gradient.

    Divides by the largest component first, so that no length under- or overflows.
    """
    largest = directions.detach().abs().amax(-1, keepdim=True)
    is_zero = largest == 0
    scaled = directions / torch.where(is_zero, 1.0, largest)
    squared = (scaled * scaled).sum(-1, keepdim=True)
    return torch.where(is_zero, 0.0, scaled / torch.where(is_zero, 1.0, squared).sqrt())


def basis(directions: Tensor, degree: int) -> Tensor:
    """Values of the harmonics up to ``degree`` at directions of any length, [n, B].

    **Convention:** order (l, m) = (0, 0), (1, -1), (1, 0), (1, 1), (2, -2), ...; signs with the Condon-Shortley phase,
    as in 3DGS and gsplat: degree 1 is c (-y, z, -x). At a direction of zero length all but the constant are zero.

    Args:
        directions: [n, 3] from the camera to the Gaussian.
        degree: 0 to 3.
    """
    count = band_count(degree)
    x, y, z = unit(directions).unbind(-1)
    values = [torch.full_like(x, C0)]
    if degree >= 1:
        values += [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        values += [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2.0 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ]
    if degree >= 3:
        values += [
            -0.5900435899266435 * y * (3.0 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4.0 * zz - xx - yy),
            0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -0.4570457994644658 * x * (4.0 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3.0 * yy),
        ]
    assert len(values) == count
    return torch.stack(values, -1)


def evaluate(coefficients: Tensor, directions: Tensor, degree: int) -> Tensor:
    """The sum of harmonics up to ``degree`` in each direction, [n, C].

    Args:
        coefficients: [n, B, C] with B at least (degree + 1)²; further ones are ignored.
        directions: [n, 3], any length, world axes, from the camera to the Gaussian. Not read at degree 0.
        degree: 0 to 3.

    Raises:
        ValueError: there are too few coefficients for the degree, or it is not 0 to 3.
    """
    count = band_count(degree)
    if coefficients.shape[1] < count:
        raise ValueError(f"degree {degree} needs {count} coefficients per channel, got {coefficients.shape[1]}")
    if degree == 0:
        return C0 * coefficients[:, 0]
    return torch.einsum("nbc,nb->nc", coefficients[:, :count], basis(directions, degree))
