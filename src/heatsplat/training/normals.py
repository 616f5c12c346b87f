"""Which way the surface faces at every Gaussian, for models that ask: from planes of points, as training views see them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from heatsplat.contracts import Camera, Frame, RenderOutput, SceneData, evenly_spread
from heatsplat.geometry.coverage import OPEN
from heatsplat.geometry.rotations import matrices_to_quats
from heatsplat.geometry.surfaces import depth_normals, on_the_side_of, plane_axes
from heatsplat.renderers.settings import Renderer

# (frame, values [N, 3] of all Gaussians, depth=bool, ratio=of the frame's pixels, camera=that looks)
Show = Callable[..., RenderOutput]

POINTS = 100_000  # of the scene's, at most
OPACITY, FLATNESS = 0.95, 0.1  # of discs, and their thickness by their radius
WIDEST = 2.0  # radius of a disc, in medians: what stands alone is no large surface


@dataclass(frozen=True)
class Discs:
    """What is known of a scene's surfaces before training: opaque discs in the planes of its points.

    Args:
        shapes: means [P, 3], rotations [P, 4], semi-axes [P, 3] and opacities [1, P], as a renderer takes them.
        normals: [P, 3] unit vectors to the side from which training views see them.
    """

    shapes: tuple[Tensor, Tensor, Tensor, Tensor]
    normals: Tensor


class Normals:
    """Unit normals of the surfaces that Gaussians show, [N, 3], pointing to the side from which they are seen.

    The scene's points become opaque discs in the planes of their neighbours. A disc faces the training cameras that see it,
    by how much of it each of them sees, so that walls in between count. What the discs show in a view is a map of normals;
    where they leave it open, the depth of the trained Gaussians fills it. A Gaussian takes the mean of the maps over the
    pixels and views that show it, by its blending weights: it faces as what it depicts, wherever along the line of sight
    training has left it.

    Between two looks normals stand still, and new Gaussians inherit them. They are a tensor of the splats, so that a
    checkpoint has those that it was written with. ``discs`` are there once ``prepare`` has looked.

    Args:
        refresh: steps before which it is looked again; the first look is before training.
        views: training views that are looked at, evenly spread.
        side: longest side of the maps in pixels.
        neighbours: points that make up a plane.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(self, refresh: Sequence[int] = (), views: int = 48, side: int = 160, neighbours: int = 12) -> None:
        if min(views, side) < 1 or neighbours < 3:
            raise ValueError(
                f"normals.views and side must be at least 1 and neighbours 3, got {views}, {side} and {neighbours}"
            )
        self.refresh = frozenset(refresh)
        self.views, self.side, self.neighbours = views, side, neighbours
        self._frames: list[tuple[Frame, float]] = []
        self._maps: list[Tensor] = []
        self.discs: Discs | None = None

    @torch.no_grad()
    def prepare(self, scene: SceneData, renderer: Renderer, means: Tensor) -> Tensor:
        """Looks at the scene's points; returns the normals [N, 3] of the points nearest to ``means`` [N, 3]."""
        self._frames = [
            _reduced(scene.train.frames[i], self.side) for i in evenly_spread(len(scene.train.frames), self.views)
        ]
        points = scene.points[torch.tensor(evenly_spread(len(scene.points), POINTS))].float()
        axes, far = plane_axes(points, points, self.neighbours)
        # Of points that are spread evenly: about the mean distance to the three nearest.
        radii = 1.8 * far / self.neighbours**0.5
        radii = radii.clamp(max=WIDEST * radii.median()).float()
        discs = (
            points,
            matrices_to_quats(axes).float(),
            torch.stack([radii, radii, FLATNESS * radii], dim=1),
            torch.full((1, len(points)), OPACITY),
        )

        def show(frame: Frame, values: Tensor, ratio: float, camera: Camera) -> RenderOutput:
            return renderer.values_seen(discs, values, camera, ratio=ratio)

        towards = torch.zeros_like(points)
        for frame, ratio in self._frames:
            everywhere = torch.ones(frame.camera.height, frame.camera.width, 3)
            seen = _gathered(show, frame, ratio, everywhere, points)
            towards += seen * torch.nn.functional.normalize(frame.camera.center.to(points) - points, dim=1)
        normals = on_the_side_of(axes[..., 2].float(), towards)
        self.discs = Discs(discs, normals)
        self._maps = []
        for frame, ratio in self._frames:
            seen = show(frame, normals, ratio=ratio, camera=frame.camera)
            shown = torch.nn.functional.normalize(seen.features, dim=-1)
            self._maps.append(torch.where((seen.alpha[0] >= OPEN)[..., None], shown, 0.0))
        _, nearest = cKDTree(points.double().numpy()).query(means.double().numpy())
        return normals[torch.from_numpy(nearest)]

    @torch.no_grad()
    def look(self, show: Show, normals: Tensor) -> Tensor:
        """New normals [N, 3] of Gaussians that ``show`` renders; those that no view shows keep their old ones."""
        total = torch.zeros_like(normals)
        for (frame, ratio), map_ in zip(self._frames, self._maps, strict=True):
            facing = map_.to(normals)
            if bool((facing == 0).all(-1).any()):
                seen = show(frame, normals, depth=True, ratio=ratio, camera=frame.camera)
                own = depth_normals(seen.depth, seen.alpha[0], frame.camera)
                facing = torch.where((facing == 0).all(-1, keepdim=True), own, facing)
            total += _gathered(show, frame, ratio, facing, normals)
        length = total.norm(dim=1, keepdim=True)
        return torch.where(length > 0, total / length.clamp(min=1e-30), normals)


def _reduced(frame: Frame, side: int) -> tuple[Frame, float]:
    """The frame on a grid of at most ``side`` pixels, and how many pixels of its own fit beside one of those."""
    camera = frame.camera
    ratio = max(1.0, max(camera.width, camera.height) / side)
    return (frame, ratio) if ratio == 1.0 else (replace(frame, camera=camera.within(side)), ratio)


def _gathered(show: Show, frame: Frame, ratio: float, map_: Tensor, like: Tensor) -> Tensor:
    """Σ_p w[p, i] map_[p] of Gaussians i, [N, 3]: a map [H, W, 3] by the blending weights of a view."""
    values = torch.zeros_like(like, requires_grad=True)
    with torch.enable_grad():
        image = show(frame, values, ratio=ratio, camera=frame.camera).features
        (gathered,) = torch.autograd.grad((image * map_).sum(), [values])
    return gathered
