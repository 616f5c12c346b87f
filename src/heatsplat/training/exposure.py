"""What hides the sun and the sky from Gaussians: the scene's depth, splatted from where they are, for models that ask.

Exposure is that to sun and sky, what shadows and the sky view factor leave; a camera's time of exposure is nowhere meant.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from heatsplat.contracts import Camera, SceneData
from heatsplat.geometry.coverage import surface_depth
from heatsplat.geometry.exposure import felt_directions, open_share, sky_directions
from heatsplat.geometry.projection import view_matrix
from heatsplat.renderers.settings import Renderer
from heatsplat.thermal.base import SKY_SEEN, SUN_SEEN
from heatsplat.training.normals import Discs

DISTANCE = 40.0  # of the camera that stands for sun or sky, in radii of the scene: rays converge by 3 degrees
NEIGHBOURS = 4  # discs of which a Gaussian takes the mean, by the inverse of their distance
TOGETHER = 1024  # Gaussians whose neighbours' shares are read at once: those of all would be four times the result
STEEPEST = 4.0  # slope of a surface against the light, beyond which its shadow on itself is no longer allowed for


class Exposure:
    """Shares of sun and sky that reach Gaussians through the scene, by maps of its depth.

    From each direction the depth of the scene's surfaces (``Discs``) is splatted as from a camera far away; trained Gaussians
    are of no use for that, as above them lies what no view shows (measured on outdoor_true: of all sunlight they keep away
    87 %, where 9 % is kept away). A disc is lit where it lies no farther than what is seen there, with an allowance
    of pixels and of its slope, over which shadows are soft; four pixels about it are looked at. What lies beyond the scene's bulk
    is lit. A Gaussian takes the mean of the discs next to it; new Gaussians inherit until it is looked again.

    Args:
        refresh: steps before which Gaussians look again for the discs next to them; the first look is before training.
        directions: over the sky.
        side: of the maps in pixels.
        allowance: pixels by which a surface may lie behind what is seen of it.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(
        self, refresh: Sequence[int] = (), directions: int = 64, side: int = 256, allowance: float = 3.0
    ) -> None:
        if min(directions, side) < 1 or allowance <= 0:
            raise ValueError(
                f"exposure.directions and side must be at least 1 and allowance above 0, got {directions}, {side} "
                f"and {allowance}"
            )
        self.refresh, self.directions = frozenset(refresh), directions
        self.side, self.allowance = side, allowance
        self._points = torch.zeros(0, 3)
        self._shares: dict[str, Tensor] = {}

    @torch.no_grad()
    def prepare(self, scene: SceneData, renderer: Renderer, discs: Discs, names: Collection[str]) -> None:
        """Looks at the discs from sun and sky, as far as SUN_SEEN and SKY_SEEN are among ``names``.

        They are looked at from afar, whatever the renderer's own ``near`` and ``far``.
        """
        self._points, self._shares = discs.shapes[0], {}
        renderer = renderer.seeing_far()
        if SUN_SEEN in names:
            directions = felt_directions(scene.weather, (frame.time_s for frame in scene.frames))
            self._shares[SUN_SEEN] = self.open(scene, renderer, discs, directions)
        if SKY_SEEN in names:
            self._shares[SKY_SEEN] = self.sky(scene, renderer, discs)

    @torch.no_grad()
    def look(self, means: Tensor) -> dict[str, Tensor]:
        """What reaches surfaces with centres [N, 3]: of the sun from each of D directions [N, D], and of the sky [N].

        Empty where nothing was asked for.
        """
        if not self._shares:
            return {}
        count = min(NEIGHBOURS, len(self._points))
        far, nearest = cKDTree(self._points.double().numpy()).query(
            means.double().cpu().numpy(), k=[*range(1, count + 1)]
        )
        weights = torch.from_numpy(1.0 / (far + 1e-9)).float()
        weights = weights / weights.sum(1, keepdim=True)

        def mean(shares: Tensor) -> Tensor:
            result = means.new_empty(len(means), *shares.shape[1:])
            parts = (rows.split(TOGETHER) for rows in (result, weights, torch.from_numpy(nearest)))
            for means_of_part, weights_of_part, ids in zip(*parts, strict=True):
                means_of_part.copy_(torch.einsum("nk,nk...->n...", weights_of_part, shares[ids]))
            return result

        return {name: mean(shares) for name, shares in self._shares.items()}

    @torch.no_grad()
    def open(self, scene: SceneData, renderer: Renderer, discs: Discs, directions: Tensor) -> Tensor:
        """How much of the light from directions [D, 3] reaches the discs, [P, D] in [0, 1]."""
        return torch.stack([self._lit(scene, renderer, discs, d) for d in directions], dim=1).to(discs.normals)

    @torch.no_grad()
    def sky(self, scene: SceneData, renderer: Renderer, discs: Discs) -> Tensor:
        """How much of the light of an even sky reaches the discs of what would without obstacles, [P] in [0, 1]."""
        directions = sky_directions(self.directions, scene.weather.up)
        return open_share(discs.normals, directions, self.open(scene, renderer, discs, directions))

    def _lit(self, scene: SceneData, renderer: Renderer, discs: Discs, direction: Tensor) -> Tensor:
        """Share [P] of the light from a direction [3] that reaches the discs."""
        camera, pixel = self._camera(scene, direction)
        means, normals = discs.shapes[0], discs.normals
        seen = renderer.values_seen(discs.shapes, means.new_zeros(len(means), 1), camera, depth=True)
        depth = surface_depth(seen.depth, seen.alpha[0]).double().cpu()
        places, z = camera.project(means.double().cpu())
        across = (normals.double().cpu() @ direction).clamp(1e-3, 1.0)
        slope = ((1 - across * across).sqrt() / across).clamp(max=STEEPEST)
        allowed = pixel * (self.allowance + slope)
        column, row = (places - 0.5).unbind(1)
        inside = (column >= 0) & (row >= 0) & (column < self.side - 1) & (row < self.side - 1)
        j, i = column.clamp(0, self.side - 2).long(), row.clamp(0, self.side - 2).long()
        right, below = (column - j).clamp(0, 1), (row - i).clamp(0, 1)
        total = torch.zeros_like(z)
        for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1)):
            weight = (below if di else 1 - below) * (right if dj else 1 - right)
            behind = z - depth[i + di, j + dj]
            total += weight * (2 - behind / allowed).clamp(0, 1)
        return torch.where(inside, total, 1.0)

    def _camera(self, scene: SceneData, direction: Tensor) -> tuple[Camera, float]:
        """A camera far away in a direction [3] that sees the scene's bulk, and the size of its pixels there."""
        centre, edge = scene.bulk
        radius = 0.87 * edge
        away = direction.double()
        helper = torch.eye(3, dtype=torch.float64)[int(away.abs().argmin())]
        right = torch.nn.functional.normalize(torch.linalg.cross(away, helper), dim=0)
        turn = torch.stack([right, torch.linalg.cross(-away, right), -away])
        viewmat = view_matrix(turn, centre.double() + DISTANCE * radius * away)
        focal = 0.5 * self.side * DISTANCE
        half = 0.5 * self.side
        K = torch.tensor([[focal, 0, half], [0, focal, half], [0, 0, 1]], dtype=torch.float64)
        return Camera(viewmat, K, self.side, self.side), 2 * radius / self.side
