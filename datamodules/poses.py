"""What makes a matrix the pose of a camera."""

from __future__ import annotations

from typing import Any

import numpy as np

from heatsplat.contracts import SceneError

# Rotations written with four digits keep to it; sheared, scaled and damaged ones do not.
TOLERANCE = 1e-3
# Units from the origin: beyond are numbers that no survey writes, and whose squares float32 cannot hold.
MAX_COORDINATE = 1e12
LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


def checked_pose(pose: Any, where: str) -> np.ndarray:
    """The rigid motion [4, 4] float64 that a 3x4 or 4x4 matrix stands for.

    Raises:
        SceneError: it is ragged, of another shape or not finite, lies absurdly far away, or its rotation is sheared,
            scaled or mirrored, or its last row is not 0 0 0 1. ``where`` is named.
    """
    try:
        matrix = np.asarray(pose, dtype=np.float64).copy()  # np.array warns of tensors
    except (TypeError, ValueError, OverflowError) as error:
        raise SceneError(f"{where} is no pose: a matrix of 4x4 numbers is needed") from error
    if matrix.shape == (3, 4):
        matrix = np.vstack([matrix, LAST_ROW])
    if matrix.shape != (4, 4):
        raise SceneError(f"{where} is no pose: it is {list(matrix.shape)}, 4x4 is needed")
    if not (np.abs(matrix) <= MAX_COORDINATE).all():
        raise SceneError(f"{where} is no pose: it holds NaN, infinite or absurdly large numbers")
    rotation = matrix[:3, :3]
    wrong = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if wrong > TOLERANCE:
        raise SceneError(
            f"{where} is no pose: its rotation R is scaled or sheared (R R^T differs from the identity by {wrong:.3g}); export "
            "the poses again without scale"
        )
    if np.abs(matrix[3] - LAST_ROW).max() > TOLERANCE:
        transposed = np.abs(matrix[:, 3] - LAST_ROW).max() <= TOLERANCE
        remedy = "it is transposed, since that is its last column" if transposed else "export the poses again"
        raise SceneError(f"{where} is no pose: its last row is {matrix[3].tolist()}, not 0 0 0 1; {remedy}")
    if np.linalg.det(rotation) < 0:
        raise SceneError(f"{where} is no pose: it mirrors the world (determinant -1); turn one axis round")
    return matrix
