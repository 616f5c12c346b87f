"""Blur of lens and detector."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from heatsplat.contracts import quantile
from heatsplat.effects.base import Effect, Evidence, Part
from heatsplat.effects.inspection import Inspection

REACH = 4  # pixels on either side of an edge within which it has to be over
SHARPEST = 0.1  # of the strong edges, the share that is judged: others are gradients of the scene and not its edges
CLEAR = 20.0  # an edge is strong when it is this many times the noise high
MIN_EDGES, MANY_EDGES = 30, 300  # of fewer than many, all may be gradients of the scene
# The width of a step that is no wider than the pixel that collects it, and one of which the reconstruction should know.
PIXEL_PX, WIDE_PX = 0.45, 0.75
UNSURE = (0.97, 1.1)  # shares of WIDE_PX between which nothing was seen


def evidence(inspected: Inspection) -> Evidence:
    """Whether edges are wider than pixels. A step's steepest pixel takes a share of it that tells its width."""
    obs = inspected.obs
    if obs.images.numel() == 0 or min(obs.images.shape[1:]) < 2 * REACH + 2:
        return Evidence(None, obs.why or "the images are too small to have edges")
    widths = []
    for f in range(len(obs.images)):
        image = obs.images[f].double()
        image = image if obs.masks is None else torch.where(obs.masks[f], image, torch.nan)
        widths += [_widths(image, obs.noise), _widths(image.mT, obs.noise)]
    widths = torch.cat(widths)
    if len(widths) < MIN_EDGES:
        why = f"cannot be told: only {len(widths)} edges stand out of the noise, {MIN_EDGES} are needed"
        return Evidence(None, why, told=False)
    sigma = float(quantile(widths, 0.5 * SHARPEST))
    spread = math.sqrt(max(sigma**2 - PIXEL_PX**2, 0.0))
    found = (
        f"the sharpest tenth of {len(widths)} edges has a width (standard deviation) of {sigma:.2f} pixels, {spread:.2f} beyond "
        "that of the pixel"
    )
    if len(widths) < MANY_EDGES and spread > 0.5 * WIDE_PX:
        return Evidence(spread / WIDE_PX, f"{found}: cannot be told, {MANY_EDGES} edges would tell", told=False)
    if UNSURE[0] < spread / WIDE_PX < UNSURE[1]:
        return Evidence(spread / WIDE_PX, f"{found}: cannot be told, finer images would tell", told=False)
    return Evidence(spread / WIDE_PX, found)


def _widths(image: Tensor, noise: float) -> Tensor:
    """Standard deviations in pixels of the strong, lone edges along the rows of an image [H, W]; none at a nan."""
    side = 2 * REACH + 1
    height = image[:, side:] - image[:, :-side]  # [H, n]; few are high, and windows take nine times the memory
    high = height.abs() > CLEAR * noise
    height, windows = height[high], image.diff(dim=1).unfold(1, side, 1)[high]  # [e], [e, side]
    sizes = windows.abs()
    lone = (height.abs() > 0.9 * sizes.sum(1) - 2 * noise) & (sizes[:, REACH] >= sizes.amax(1) - 1e-12)
    share = windows[lone] / height[lone][:, None]
    at = torch.arange(-REACH, REACH + 1, dtype=image.dtype)
    mean = (share * at).sum(1, keepdim=True)
    return (share * (at - mean) ** 2).sum(1).clamp_min(0.0).sqrt()


EFFECT = Effect(
    name="point_spread",
    stage="sensor",
    place=0,
    summary="blur of lens and detector",
    source="SupIR-GS, degradation model",
    null="edges are as wide as a pixel",
    # WIDE_PX; up to 0.98 without it, from 1.17 with it.
    threshold=1.0,
    adds="a Gaussian blur of the rendered image",
    evidence=evidence,
    part=Part("camera", "point_spread"),
)
