"""A surface of a trained scene: what its Gaussians show its training views, fused (``geometry.fusion``)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from heatsplat.contracts import SceneError, View, counted, quantile
from heatsplat.export.moment import Moment
from heatsplat.geometry.closest_depth import closest_depth
from heatsplat.geometry.coverage import Sighting
from heatsplat.geometry.fusion import Surface, TooLarge, blocks_near, footprint, fuse

log = logging.getLogger("heatsplat")

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
    """Depth [H, W] (camera z) of the surface that a training view shows, and over how much depth its opacity lies [H, W]
    (``geometry.closest_depth``); infinite where a pixel is open, or its mask leaves it out."""
    moment = moment if moment.whole is None else moment.whole
    seen, camera = moment.seen, view.frame.camera
    shapes = seen.means, seen.quats, seen.scales, seen.opacities[None]
    return closest_depth(partial(moment.module.renderer.depths_at_shares, shapes), camera, view.mask)


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
