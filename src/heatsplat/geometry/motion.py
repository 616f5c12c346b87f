"""How a camera moves, and how what it sees moves through its image."""

from __future__ import annotations

import torch
from scipy.spatial.transform import Rotation
from torch import Tensor


def twists(viewmats: Tensor, times_s: Tensor) -> Tensor:
    """How the world moves in the axes of each camera of a record, [F, 6] float64: ω in rad/s and v in units/s.

    A point X there has the velocity ω x X + v. The derivative is that of a parabola through a pose and its two neighbours
    in time, of a line at the ends of the record, and zero where no other time is known.

    Args:
        viewmats: [F, 4, 4] world to camera.
        times_s: [F], not decreasing.
    """
    viewmats, times_s = viewmats.double(), times_s.double()
    found = torch.zeros(len(viewmats), 6, dtype=torch.float64)
    for i, now in enumerate(times_s):
        earlier, later = (times_s < now).nonzero()[-1:, 0], (times_s > now).nonzero()[:1, 0]
        slopes, gaps = [], []
        for other in (*earlier.tolist(), *later.tolist()):
            moved = viewmats[other] @ torch.linalg.inv(viewmats[i])
            turn = torch.from_numpy(Rotation.from_matrix(moved[:3, :3].numpy()).as_rotvec())
            gaps.append(times_s[other] - now)
            slopes.append(torch.cat([turn, moved[:3, 3]]) / gaps[-1])
        if len(slopes) == 2:  # the nearer neighbour says more
            before, after = -gaps[0], gaps[1]
            found[i] = (after * slopes[0] + before * slopes[1]) / (before + after)
        elif slopes:
            found[i] = slopes[0]
    return found


def screen_velocity(pixels: Tensor, nearness: Tensor, K: Tensor, twist: Tensor) -> Tensor:
    """Velocities [..., 2] in pixels per second of what is seen at ``pixels`` [..., 2].

    Args:
        nearness: [...] one over the depth (camera z) there; 0 for what is infinitely far.
        K: [3, 3] intrinsics in pixels.
        twist: [6], of ``twists``.
    """
    focal = torch.stack([K[0, 0], K[1, 1]])
    at = (pixels - K[:2, 2]) / focal
    rays = torch.cat([at, torch.ones_like(at[..., :1])], -1)
    flow = torch.linalg.cross(twist[:3].expand_as(rays), rays) + twist[3:] * nearness[..., None]
    return focal * (flow[..., :2] - at * flow[..., 2:])
