"""Growing and pruning of anchors, by what becomes of the Gaussians that are made from them (Scaffold-GS, CVPR 2024)."""

from __future__ import annotations

import torch
from torch import Tensor

from heatsplat.contracts import Camera, RenderOutput, SceneData, SceneError
from heatsplat.density.base import DensityChange, DensityControl, ndc_gradient_norms
from heatsplat.density.ops import Cloud
from heatsplat.geometry.voxels import among, cells, middles, spacing
from heatsplat.splats import ANCHORS


class Anchors(DensityControl):
    """New anchors where Gaussians of old ones still pull, in empty cubes of several sizes; none where all is transparent.

    Level m = 0, 1, ... has cubes of ``coarsest`` / ``finer``^m voxels and the threshold ``grad_threshold`` (finer / 2)^m. A
    Gaussian that pulls more than that asks for an anchor in the middle of its cube, where there is none, and is heard with
    probability 1 - 2^-(m+1). The new anchor is as large as the cube; of the features of those that asked it takes the
    largest in each number; its Gaussians start at its place. An anchor goes whose Gaussians' opacities, summed, were below
    ``prune_opacity`` in the mean of the views that saw it.

    The pull is the norm of the gradient by the screen position in normalised device coordinates (two units per image side),
    in the mean of the views that showed the Gaussian. The paper means it over all Gaussians of a cube; this is the public
    code's rule.

    Args:
        start: first step that counts.
        grow_from, stop: first step with growth and pruning, and the step from which on there is none.
        every: steps between two of them.
        seen: share of ``every`` in which an anchor was in view before it may go; half of it for a Gaussian that asks.
        grad_threshold: of the pull, at the first level.
        prune_opacity: as above.
        voxel: edge in world units; None takes the median distance of the scene's points to the nearest other one.
        coarsest, finer, levels: of the cubes.
        cap_max: never more anchors than this; the strongest pull first.

    Raises:
        ValueError: an option is out of its range.
    """

    rows = frozenset({ANCHORS})
    milestones, intervals = ("start", "grow_from", "stop"), ("every",)

    def __init__(
        self,
        start: int = 500,
        grow_from: int = 1500,
        stop: int = 15_000,
        every: int = 100,
        seen: float = 0.8,
        grad_threshold: float = 2e-4,
        prune_opacity: float = 0.005,
        voxel: float | None = None,
        coarsest: int = 16,
        finer: int = 4,
        levels: int = 3,
        cap_max: float = 100_000,
    ) -> None:
        if min(every, levels, coarsest, cap_max) < 1 or finer < 2 or (voxel is not None and not voxel > 0):
            raise ValueError(
                "density.every, levels, coarsest and cap_max must be at least 1, finer at least 2 and voxel positive, got "
                f"{every}, {levels}, {coarsest}, {cap_max}, {finer} and {voxel}"
            )
        if min(start, grow_from, stop, seen, grad_threshold, prune_opacity) < 0:
            raise ValueError(
                "density.start, grow_from, stop, seen, grad_threshold and prune_opacity must not be negative, got "
                f"{start}, {grow_from}, {stop}, {seen}, {grad_threshold} and {prune_opacity}"
            )
        self.start, self.grow_from, self.stop, self.every, self.seen = start, grow_from, stop, every, seen
        self.grad_threshold, self.prune_opacity = grad_threshold, prune_opacity
        self.voxel, self.coarsest, self.finer, self.levels = voxel, coarsest, finer, levels
        self.cap_max = cap_max

    def prepare(self, scene: SceneData, modality: str) -> None:
        self.size = self.voxel or spacing(scene.points)
        if self.size == 0:
            raise SceneError(
                f"most points of scene '{scene.name}' coincide, so no voxel size can be derived from them: give density.voxel"
            )

    def initial_state(self, count: int, device: torch.device) -> dict[str, Tensor]:
        """ "opacity" and "views" [N] of anchors; "gradient" and "shown" [N, k] of their Gaussians come with the first view."""
        return {name: torch.zeros(count, device=device) for name in ("opacity", "views")}

    @torch.no_grad()
    def observe(self, state: dict[str, Tensor], output: RenderOutput, camera: Camera, step: int) -> None:
        if not self.start <= step < self.stop:
            return
        means2d, ids = output.meta["means2d"], output.meta["visible_ids"]
        count = len(state["views"])
        for name in ("gradient", "shown"):
            if name not in state:
                state[name] = means2d.new_zeros(count, len(means2d) // count)
        in_view = output.meta["rows_in_view"]
        state["views"] += in_view
        state["opacity"] += in_view * output.meta["opacities"][0].view(count, -1).sum(1)
        pull = ndc_gradient_norms(output, camera)
        if pull is None:
            return
        state["gradient"].view(-1).index_add_(0, ids, pull.to(state["gradient"]))
        state["shown"].view(-1).index_add_(0, ids, torch.ones_like(ids, dtype=state["shown"].dtype))

    @torch.no_grad()
    def refine(self, cloud: Cloud, step: int, extent: float, generator: torch.Generator) -> DensityChange | None:
        if not self.grow_from <= step < self.stop or not self._comes("every", step) or "shown" not in cloud.state:
            return None
        state, before = cloud.state, len(cloud)
        heard = state["shown"] > self.seen * self.every / 2
        self._grow(cloud, (state["gradient"] / state["shown"].clamp(min=1)).where(heard, 0.0), generator)
        added = len(cloud) - before
        for name in ("gradient", "shown"):
            state[name][:before][heard] = 0
        known = state["views"] > self.seen * self.every
        gone = known & (state["opacity"] < self.prune_opacity * state["views"])
        for name in ("opacity", "views"):
            state[name][known] = 0
        removed = cloud.prune(
            ~gone,
            f"density control would prune all {len(cloud)} anchors at step {step}: the opacities of the Gaussians of each "
            f"sum up to less than {self.prune_opacity}. Lower the learning rates or density.prune_opacity.",
        )
        return DensityChange(added, removed)

    def _grow(self, cloud: Cloud, pull: Tensor, generator: torch.Generator) -> None:
        splats = cloud.splats
        places = splats.means[:, None] + splats["offsets"] * splats["log_reach"].exp()[:, None]  # of old Gaussians
        parents = torch.arange(len(cloud), device=pull.device)[:, None].expand_as(pull)
        for level in range(self.levels):
            size = self.size * self.coarsest / self.finer**level
            drawn = torch.rand(pull.shape, generator=generator).to(pull.device)
            asks = (pull >= self.grad_threshold * (self.finer / 2) ** level) & (pull > 0) & (drawn > 0.5 ** (level + 1))
            cubes = cells(places[asks], size)
            free = ~among(cubes, cells(cloud.splats.means, size))
            cubes, inverse = torch.unique(cubes[free], dim=0, return_inverse=True)
            room = int(max(0, min(self.cap_max - len(cloud), len(cubes))))
            if room == 0:
                continue
            strongest = pull.new_zeros(len(cubes)).scatter_reduce(0, inverse, pull[asks][free], "amax")
            features = splats["feature"].detach()[parents[asks][free]]
            largest = features.new_zeros(len(cubes), features.shape[1]).scatter_reduce(
                0, inverse[:, None].expand_as(features), features, "amax", include_self=False
            )
            chosen = strongest.argsort(descending=True, stable=True)[:room].sort().values
            self._add(cloud, middles(cubes[chosen], size), size, largest[chosen])

    @staticmethod
    def _add(cloud: Cloud, means: Tensor, size: float, features: Tensor) -> None:
        """Anchors with these features, as large as their cubes, whose Gaussians lie where they do."""
        rows = cloud.rows(torch.zeros(len(means), dtype=torch.int64, device=means.device))
        sizes = torch.tensor(size).log().item()
        rows["log_scales"].fill_(sizes)
        rows["log_reach"].fill_(sizes)
        rows["offsets"].zero_()
        rows["means"], rows["feature"] = means.to(rows["means"]), features
        cloud.append(rows)
