"""Camera paths to render along: a circle around the scene, a smooth way through given cameras, a fixed view."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from heatsplat.contracts import Camera
from heatsplat.geometry.projection import look_at, view_matrix
from heatsplat.geometry.rotations import matrices_to_quats, quats_to_matrices, slerp

ONE_SIDED = (
    0.8  # length of the mean viewing direction from which cameras count as looking the same way (within 37 degrees)
)


def fixed_view(camera: Camera, count: int) -> list[Camera]:
    """The same camera ``count`` times: a fixed view through time."""
    return [camera] * count


def orbit(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """``count`` cameras on a closed circle that looks at what the given cameras look at.

    **Convention:** the circle lies at their mean height and radius about an axis through the centre of attention; the
    first camera stands towards the first given one. The axis is the mean upward direction, or, where the given cameras
    all look the same way (a wall, or the ground from a drone), the direction from which they look: a circle about the
    upward direction would lead behind the scene. Intrinsics and image size are the first camera's.

    Raises:
        ValueError: there is no camera, or all of them stand on the axis, so that there is no circle.
    """
    _need_cameras(cameras)
    centre, up = attention(cameras), upward(cameras)
    facing = torch.stack([camera.viewmat[2, :3] for camera in cameras]).mean(0)
    axis = -facing / facing.norm() if facing.norm() > ONE_SIDED else up
    offsets = torch.stack([camera.center for camera in cameras]) - centre
    heights = offsets @ axis
    outward = offsets - heights[:, None] * axis
    radii = outward.norm(dim=1)
    if radii.max() < 1e-6 * (1 + offsets.norm(dim=1).max()):
        raise ValueError(
            "the training cameras stand at one place or on one line of sight and give no orbit; choose trajectory=path or view "
            "instead"
        )
    first = outward[radii.argmax()] if radii[0] < 1e-3 * radii.max() else outward[0]
    first = first / first.norm()
    second = torch.linalg.cross(axis, first)
    path = []
    for angle in (2 * math.pi * i / count for i in range(count)):
        arm = math.cos(angle) * first + math.sin(angle) * second
        viewmat = look_at(centre + heights.mean() * axis + radii.mean() * arm, centre, up)
        path.append(Camera(viewmat, cameras[0].K, cameras[0].width, cameras[0].height))
    return path


def interpolate(cameras: Sequence[Camera], count: int) -> list[Camera]:
    """``count`` cameras on a smooth way through all given ones, from the first to the last.

    **Convention:** positions on a Catmull-Rom spline, rotations by slerp, intrinsics linearly between neighbours at the
    image size of the first camera; equal shares of the frames between neighbours. A single camera gives a fixed view.

    Raises:
        ValueError: there is no camera.
    """
    _need_cameras(cameras)
    if len(cameras) == 1:
        return fixed_view(cameras[0], count)
    width, height = cameras[0].width, cameras[0].height
    centres = torch.stack([camera.center for camera in cameras])
    quats = matrices_to_quats(torch.stack([camera.viewmat[:3, :3] for camera in cameras]))
    intrinsics = torch.stack([camera.resized(width, height).K for camera in cameras])
    path = []
    for t in torch.linspace(0, len(cameras) - 1, count, dtype=torch.float64).tolist():
        i = min(int(t), len(cameras) - 2)
        u = t - i
        viewmat = view_matrix(quats_to_matrices(slerp(quats[i], quats[i + 1], u)), _catmull_rom(centres, i, u))
        path.append(Camera(viewmat, torch.lerp(intrinsics[i], intrinsics[i + 1], u), width, height))
    return path


def attention(cameras: Sequence[Camera]) -> Tensor:
    """The point [3] that is nearest to the optical axes of all cameras, in the sense of least squares.

    Axes that are parallel, or that meet behind the cameras, leave it open how far away it is: then it lies ahead of the
    cameras' mean, as far as they stand from it on average.
    """
    centres = torch.stack([camera.center for camera in cameras])
    forward = torch.stack([camera.viewmat[2, :3] for camera in cameras])
    across = torch.eye(3, dtype=torch.float64) - forward[:, :, None] * forward[:, None, :]
    if torch.linalg.eigvalsh(across.mean(0))[0] > 1e-6:
        point = torch.linalg.solve(across.sum(0), (across @ centres[:, :, None]).sum(0)).squeeze(-1)
        if ((point - centres) * forward).sum() >= 0:
            return point
    middle, ahead = centres.mean(0), forward.mean(0)
    distance = (centres - middle).norm(dim=1).mean()
    return middle + (distance if distance > 0 else 1.0) * ahead / ahead.norm().clamp(min=1e-12)


def upward(cameras: Sequence[Camera]) -> Tensor:
    """Mean upward direction [3] of the cameras' images, of unit length; that of the first one where they cancel."""
    ups = torch.stack([-camera.viewmat[1, :3] for camera in cameras])
    mean = ups.mean(0)
    return mean / mean.norm() if mean.norm() > 1e-3 else ups[0]


def _catmull_rom(points: Tensor, i: int, u: float) -> Tensor:
    """The point [3] a fraction ``u`` of the way from ``points[i]`` to the next; the ends are continued straight."""
    before = points[i - 1] if i > 0 else 2 * points[i] - points[i + 1]
    after = points[i + 2] if i + 2 < len(points) else 2 * points[i + 1] - points[i]
    start, end = points[i], points[i + 1]
    leave, arrive = 0.5 * (end - before), 0.5 * (after - start)
    return (
        (2 * u**3 - 3 * u**2 + 1) * start
        + (u**3 - 2 * u**2 + u) * leave
        + (3 * u**2 - 2 * u**3) * end
        + (u**3 - u**2) * arrive
    )


def _need_cameras(cameras: Sequence[Camera]) -> None:
    if len(cameras) == 0:
        raise ValueError("a trajectory needs at least one camera")
