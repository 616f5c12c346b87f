"""Points of surfaces from images and cameras, for scenes whose own points are random ones."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import Camera, SceneData, View, evenly_spread
from heatsplat.effects.observations import standardised
from heatsplat.geometry.projection import to_camera, to_world
from heatsplat.physics.noise import noise_of, usual_quantum

log = logging.getLogger(__name__)

WIDEST = 160  # pixels along the longer side of the images that are swept; larger ones shrink
MAX_VIEWS, REFERENCES, BESIDE = 64, 8, 6  # views that are looked at, swept, and compared with each of these
PIXELS = 160  # of a swept view, those with the most texture
REACH = 2  # pixels on either side of a patch
NEAREST, FARTHEST = 0.2, 3.0  # depths that are tried, in distances of the camera to the middle of the scene
DEPTHS = 96
TURNED = 0.04  # least distance of two cameras that are compared, in the same unit
TEXTURE = 4.0  # standard deviation of a patch, in those of the noise
ALIKE = 0.9  # correlation of patches that show one surface
AMBIGUOUS = 0.03  # a depth that is as good but for this, far from the best one, leaves a pixel undecided


def with_swept_points(scene: SceneData) -> SceneData:
    """The scene with points that its images show in place of random ones; the same where it has points of its own."""
    if "points_random" not in scene.notes:
        return scene
    points = swept_points(scene).float()
    log.info("the scene has no points of its own: effects are looked for at %d that its images show", len(points))
    return replace(scene, points=points, point_colors=None)


def swept_points(scene: SceneData) -> Tensor:
    """Points [P, 3] float64 in the world, on surfaces with texture that several training views show alike; possibly none.

    A plane sweep (Collins 1996): for pixels of some views, the depth at which the patch around them correlates best with what
    other views show there. Correlation does not mind a level and a gain of each image, so that a scene may cool meanwhile.

    Args:
        scene: whose points, random ones in the cube that the cameras look at, tell where the middle of the scene is.
    """
    cameras, images = [], []
    for i in evenly_spread(len(scene.train), MAX_VIEWS):
        view = scene.train[i]
        if view.thermal is not None:
            cameras.append(view.camera)
            images.append(_shrunk(view))
    none = torch.zeros(0, 3, dtype=torch.float64)
    if len(images) < 3 or len(scene.points) == 0:
        return none
    noise = 0.0
    if len({image.shape for image in images}) == 1:
        stacked = torch.stack(images)
        noise = noise_of(stacked.nan_to_num(), usual_quantum(stacked), stacked.isfinite())
    middle = scene.points.double().mean(0)
    found = [none]
    for k in evenly_spread(len(images), REFERENCES):
        others = _beside(cameras, k, middle)
        if len(others) >= 3:
            found.append(_swept(cameras, images, k, others, noise, middle))
    return torch.cat(found)


def _shrunk(view: View) -> Tensor:
    image = view.thermal.mean(2).double()
    if (known := view.known) is not None:
        image = torch.where(known, image, torch.nan)
    return functional.avg_pool2d(image[None, None], _block(view.camera))[0, 0]


def _block(camera: Camera) -> int:
    """Pixels along each side of those of which a swept image has the mean; at the right and below some may be left out."""
    return math.ceil(max(camera.height, camera.width) / WIDEST)


def _beside(cameras: Sequence[Camera], k: int, middle: Tensor) -> list[int]:
    """The cameras nearest to one, of those that see the scene from elsewhere."""
    centres = torch.stack([camera.center for camera in cameras])
    apart = (centres - centres[k]).norm(dim=1) / (middle - centres[k]).norm().clamp_min(1e-9)
    return [int(i) for i in apart.argsort() if apart[i] > TURNED][:BESIDE]


def _swept(
    cameras: Sequence[Camera], images: Sequence[Tensor], k: int, others: Sequence[int], noise: float, middle: Tensor
) -> Tensor:
    """Points [n, 3] of one view."""
    camera = cameras[k]
    patches, places = _textured(images[k], noise)
    if not len(patches):
        return images[k].new_zeros(0, 3)
    own, at = standardised(patches), _block(camera) * places
    rays = torch.linalg.solve(camera.K, torch.cat([at, torch.ones_like(at[..., :1])], 2)[..., None])[..., 0]
    away = float((middle - camera.center).norm())
    depths = 1.0 / torch.linspace(1.0 / (FARTHEST * away), 1.0 / (NEAREST * away), DEPTHS, dtype=torch.float64)
    alike = torch.stack([_alike(own, rays, depths, camera.viewmat, cameras[i], images[i]) for i in others])
    kept, nearness = _peaks(_agreed(alike), depths)
    middles = rays[kept, rays.shape[1] // 2]
    return to_world(middles / nearness[:, None], camera.viewmat)


def _textured(image: Tensor, noise: float) -> tuple[Tensor, Tensor]:
    """Patches [n, q] of an image [H, W] that show most, and the places [n, q, 2] (x, y) of their pixels in it."""
    side = 2 * REACH + 1
    patches = image.unfold(0, side, 1).unfold(1, side, 1).flatten(2)  # [H - 2 REACH, W - 2 REACH, q]
    texture = patches.std(2).nan_to_num(0.0).flatten()
    order = texture.argsort(descending=True)
    order = order[texture[order] > max(TEXTURE * noise, 1e-6)]
    order = order[evenly_spread(len(order), PIXELS)]
    top, left = order // patches.shape[1], order % patches.shape[1]
    offsets = torch.arange(side, dtype=torch.float64)
    down, right = torch.meshgrid(offsets, offsets, indexing="ij")
    places = torch.stack([left[:, None] + right.flatten(), top[:, None] + down.flatten()], 2) + 0.5
    return patches.flatten(0, 1)[order], places


def _agreed(alike: Tensor) -> Tensor:
    """How much other views agree on each depth [n, D], from what each of them says [V, n, D] (nan where it does not see it): the
    mean of the better half, as the others may be hidden; -1 where fewer see it."""
    half = len(alike) // 2
    better = alike.nan_to_num(-1.0).sort(dim=0, descending=True).values[: half + 1]
    return torch.where(alike.isfinite().sum(0) > half, better.mean(0), -1.0)


def _peaks(score: Tensor, depths: Tensor) -> tuple[Tensor, Tensor]:
    """Which pixels [n] have one depth that is clearly the best of ``depths`` [D], none at their ends, by a score [n, D]; and one
    over the depth of these, to a part of a step."""
    best, place = score.max(1)
    far = (torch.arange(DEPTHS) - place[:, None]).abs() > 4
    rival = torch.where(far, score, -1.0).amax(1)
    inner = (place > 0) & (place < DEPTHS - 1)
    kept = (best > ALIKE) & (rival < best - AMBIGUOUS) & inner
    score, place = score[kept], place[kept]
    before, peak, after = (score.gather(1, (place + step)[:, None])[:, 0] for step in (-1, 0, 1))
    shift = 0.5 * (before - after) / (before - 2.0 * peak + after).clamp_max(-1e-9)  # of a parabola's top
    return kept, 1.0 / depths[place] + shift * (1.0 / depths[1] - 1.0 / depths[0])


def _alike(own: Tensor, rays: Tensor, depths: Tensor, viewmat: Tensor, camera: Camera, image: Tensor) -> Tensor:
    """Correlation [n, D] of patches ``own`` [n, q] with what an image shows where they would lie at each depth; nan outside."""
    points = rays[:, None] * depths[:, None, None]  # [n, D, q, 3]
    local = to_camera(to_world(points, viewmat).flatten(0, 2), camera.viewmat)
    ahead = local[:, 2] > 1e-6
    pixels = (local @ camera.K.T)[:, :2] / local[:, 2:].clamp_min(1e-6)
    height, width = image.shape
    positions = 2.0 * pixels / (_block(camera) * pixels.new_tensor([width, height])) - 1.0
    inside = (ahead & (positions.abs() < 1.0).all(1)).view(points.shape[:3]).all(2)
    values = functional.grid_sample(image[None, None], positions[None, None], align_corners=False)[0, 0, 0]
    correlation = (standardised(values.view(points.shape[:3])) * own[:, None]).sum(2)
    return torch.where(inside, correlation, torch.nan)
