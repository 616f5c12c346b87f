"""A surface of a trained scene: what its Gaussians show its training views, fused (``geometry.fusion``)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from heatsplat.contracts import SceneError, View, counted, quantile
from heatsplat.export.moment import Moment
from heatsplat.geometry.coverage import Sighting, surface_depth
from heatsplat.geometry.fusion import Surface, TooLarge, blocks_near, footprint, fuse
from heatsplat.geometry.projection import to_camera

log = logging.getLogger("heatsplat")

# Gaussians make no thin sheets: along a ray their opacity is spread over many widths of a pixel, before the surface or behind
# it, so that the mean depth lies far off. The surface is where opacity lies closest: the middle of the shortest stretch with this
# share of it. Vertices on "cooling" and "outdoor" err by 1.7 and 0.7 widths (median; 1,500 steps), by the median depth by 2.0 and
# 1.0, by the mean depth by 3.2 and 9. Where that stretch is longer than the truncation, a pixel shows fog.
STRETCH = 0.4
SHARES = 16  # starts of stretches that are compared
DEPTHS = 96  # of a view at which the opacity before them is taken, linear in between
TOGETHER = 4  # of them in one image; more channels take longer each
BESIDE = 0.5, 1.3  # of the nearest and the farthest mean depth, between which half of them lie
VOXEL = 3.0  # widths of a pixel on the surface: what Gaussians show is not finer
TRUNCATION = 4.0  # voxels, at least
# Views of a flat heath from 75 m disagree on its depth by metres. At a reach of 4 voxels a third of its pixels show fog, and a
# twentieth of what they show stays open; at the stretch that nine in ten pixels stay below nothing does. Indoors that is below
# 3 voxels, where a longer reach rounds off walls ("static": errors of 23 mm at 4 voxels, 30 at 8).
CLEAR = 0.9
MOST = 2**26  # voxels, of 8 bytes each
COARSER = 1.25  # factor between edges of voxels that are tried


@torch.no_grad()
def closest(moment: Moment, view: View) -> tuple[Tensor, Tensor]:
    """Depth [H, W] (camera z) of the surface that a training view shows, where its opacity lies closest, and over how much depth
    that lies [H, W]; infinite where a pixel is open, or its mask leaves it out."""
    moment = moment if moment.whole is None else moment.whole
    seen, camera = moment.seen, view.frame.camera
    shapes = seen.means, seen.quats, seen.scales, seen.opacities[None]
    z = to_camera(seen.means.double(), camera.viewmat.to(seen.means.device))[:, 2].float()
    values_seen = moment.module.renderer.values_seen
    output = values_seen(shapes, moment.blended[:, None], camera, depth=True)  # as a look has it
    alpha = output.alpha[0]
    mean = surface_depth(output.depth, alpha)
    known = mean.isfinite() if view.mask is None else mean.isfinite() & view.mask.to(mean.device)
    nothing = torch.full(mean.shape, torch.inf)
    if not known.any():
        return nothing, nothing
    there = mean[known]
    ends = [there.min().mul(BESIDE[0]).item(), there.max().mul(BESIDE[1]).item()]
    evenly = torch.linspace(0, 1, DEPTHS // 2).to(there)
    ends = torch.cat([quantile(there, evenly), ends[0] + (ends[1] - ends[0]) * evenly]).sort().values
    parts = [values_seen(shapes, (z[:, None] < some).float(), camera).features[known] for some in ends.split(TOGETHER)]
    before = torch.cat(parts, dim=-1) / alpha[known, None]
    # Shares of the opacity at even steps, so that a stretch is a number of them.
    step = STRETCH / SHARES
    shares = torch.arange(step, 1 - 0.5 * step, step).to(before)
    after = torch.searchsorted(before.cummax(1).values, shares.repeat(len(before), 1)).clamp(1, DEPTHS - 1)
    start, end = before.gather(1, after - 1), before.gather(1, after)
    depths = torch.lerp(ends[after - 1], ends[after], ((shares - start) / (end - start).clamp(min=1e-6)).clamp(0, 1))
    spread, first = (depths[:, SHARES:] - depths[:, :-SHARES]).min(1, keepdim=True)
    found = []
    for values in (depths.gather(1, first + SHARES // 2), spread):
        found.append(nothing.clone())
        found[-1][known.cpu()] = values[:, 0].cpu()
    return found[0], found[1]


def made_surface(
    moment: Moment,
    views: Sequence[View],
    voxel: float | None,
    truncation: float | None,
    smoothing: int,
    least_piece: float,
) -> tuple[Surface, list[Tensor]]:
    """The surface that Gaussians show training views, in the world, and the depth [H, W] of it in each of them (``closest``).

    Args:
        moment: its box leaves out what lies outside.
        views: training views.
        voxel: edge of a voxel in the unit of the scene; None takes ``VOXEL`` widths of a pixel on the surface (median), or as
            few more as it takes for ``MOST`` voxels.
        truncation: voxels before and behind a surface that a view tells of; None takes ``TRUNCATION`` of them, or the stretch
            along the ray over which opacity is spread in a share of ``CLEAR`` of the pixels, if that is longer.
        smoothing: rounds in which ripples are taken off (``Surface.smoothed``).
        least_piece: share of the area below which connected pieces are left out.

    Raises:
        SceneError: no view shows a surface, or the voxels are too many.
    """
    found = [closest(moment, view) for view in views]
    maps = [Sighting(view.frame.camera, depth) for view, (depth, _) in zip(views, found, strict=True)]
    spreads = [spread for _, spread in found]
    width = footprint(maps)
    if width is None:
        raise SceneError(
            "no training view shows a surface to make a mesh of: train longer, or give what.mesh=FILE, a mesh of your own"
        )
    far = 0.0 if truncation is not None else float(quantile(torch.cat([one[one.isfinite()] for one in spreads]), CLEAR))
    box = None if moment.box is None else moment.box - moment.module.scene.origin
    wanted = size = VOXEL * width if voxel is None else voxel
    while True:
        reach = max((truncation or TRUNCATION) * size, far)
        clear = [
            replace(one, depth=one.depth.where(spread <= reach, torch.inf))
            for one, spread in zip(maps, spreads, strict=True)
        ]
        try:
            blocks = blocks_near(clear, size, reach, MOST, box)
            break
        except TooLarge:
            size *= COARSER
    if size > wanted:
        few = f"make more than {MOST / 1e6:.0f} million of them ({8 * MOST / 2**20:.0f} MB)"
        if voxel is not None:
            raise SceneError(
                f"what.voxel={voxel:g}: voxels of this width {few}; {size:.3g} fits, or a part of the scene (box)"
            )
        log.warning("voxels are %.3g wide, as %.3g would %s; box makes a finer mesh of a part", size, wanted, few)
    surface = fuse(clear, blocks, size, reach).smoothed(smoothing)
    whole = surface if box is None else surface.inside(box)
    kept = whole.without_pieces(least_piece)
    if not len(kept.faces):
        raise SceneError(
            f"no surface is found with voxels of {size:.3g}: {'none lies in the box, or ' if box is not None else ''}what views "
            f"show is spread over more than {reach:.3g} along their rays. Give a coarser what.voxel or a larger "
            f"what.truncation, or train longer; without what.voxel it is {VOXEL * width:.3g}"
        )
    log.info(
        "mesh of %d triangles from %s; voxels are %.3g wide, a pixel on the surface %.3g (median); %d triangles of pieces below "
        "%g of the area are left out", len(kept.faces), counted(len(views), "view"), size, width,
        len(whole.faces) - len(kept.faces), least_piece,
    )  # fmt: skip
    return kept, [one.depth for one in maps]
