"""How far away the surface is that Gaussians show: where along a pixel's ray their opacity lies closest."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from heatsplat.contracts import Camera
from heatsplat.geometry.coverage import OPEN

# Gaussians make no thin sheets: along a ray their opacity is spread over many widths of a pixel, before the surface or behind
# it, so that the mean depth lies far off. The surface is where opacity lies closest: the middle of the shortest stretch with this
# share of it. Vertices on "cooling" and "outdoor" err by 1.7 and 0.7 widths (median; 1,500 steps), by the median depth by 2.0 and
# 1.0, by the mean depth by 3.2 and 9. Where that stretch is longer than the truncation, a pixel shows fog.
STRETCH = 0.4
STARTS = 16  # shares of the opacity from one start of a stretch to its end; stretches start at each of them
STEP = STRETCH / STARTS
SHARES = tuple(STEP * number for number in range(1, round(1 / STEP)))


AT_ONCE = 1 << 18  # pixels that are looked at together, in 100 MB


@torch.no_grad()
def closest_depth(
    depths_at_shares: Callable[[Camera, Sequence[float]], tuple[Tensor, Tensor]],
    camera: Camera,
    mask: Tensor | None = None,
) -> tuple[Tensor, Tensor]:
    """Depth [H, W] (camera z) of the surface that Gaussians show a camera, where their opacity lies closest, and over how much
    depth that lies [H, W]; infinite where a pixel is open, or the mask leaves it out. In world units, on the CPU (ours).

    Args:
        depths_at_shares: alpha [H, W] that a camera sees, and the depths [H, W, S] at which its pixels reach shares of it
            (``Renderer.depths_at_shares``).
        mask: [H, W] bool, pixels that are looked at; None means all.
    """
    found, rows = [], max(1, AT_ONCE // camera.width)
    for first in range(0, camera.height, rows):
        strip = camera
        if rows < camera.height:
            K = camera.K.clone()
            K[1, 2] -= first
            strip = replace(camera, K=K, height=min(rows, camera.height - first))
        alpha, depths = depths_at_shares(strip, SHARES)
        spread, start = (depths[..., STARTS:] - depths[..., :-STARTS]).min(-1, keepdim=True)
        both = torch.cat([depths.gather(-1, start + STARTS // 2), spread], dim=-1)
        found.append(both.where((alpha >= OPEN)[..., None], torch.inf))
    depth, spread = (torch.cat(found) if len(found) > 1 else found[0]).unbind(-1)
    if mask is None:
        return depth, spread
    return depth.where(mask.cpu(), torch.inf), spread.where(mask.cpu(), torch.inf)
