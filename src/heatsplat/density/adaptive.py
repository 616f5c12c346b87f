"""Adaptive density control, the standard strategy of 3D Gaussian Splatting (Kerbl et al. 2023, section 5), with a cap."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from heatsplat.contracts import Camera, RenderOutput
from heatsplat.density.base import DensityChange, DensityControl, ndc_gradient_norms
from heatsplat.density.ops import Cloud
from heatsplat.geometry.rotations import quats_to_matrices

SPLIT_SHRINK = 1.6  # scales of the two halves of a split Gaussian (Kerbl et al. 2023)
RECOVERY = 10  # refinements after which opacities have come back from a reset


class Adaptive(DensityControl):
    """Duplicates small and splits large Gaussians whose screen position still pulls, prunes those that are transparent.

    The statistic is the norm of the loss gradient with respect to the screen position in normalised device coordinates
    (two units per image side), averaged over the views since the last refinement that saw the Gaussian.

    Args:
        start, stop: first and last step at which Gaussians are added or removed.
        every: steps between refinements.
        grad_threshold: growth above this mean gradient (per NDC unit).
        duplicate_scale: Gaussians with a largest semi-axis up to this (times extent) are duplicated, larger ones split.
        prune_opacity: Gaussians below this opacity (in every modality) are removed.
        prune_scale: after the first opacity reset, Gaussians with a semi-axis above this (times extent) are removed.
        reset_every: steps between opacity resets; none at or after ``stop``, nor while a stage holds opacities still, nor so
            shortly before that they would not come back. None: no resets.
        reset_opacity: opacities are lowered to at most this, as rendered.
        cap_max: never more Gaussians than this, infinity for no limit; the strongest gradients grow first.
        multiple: nor more than so many times ``initial_count``; None: ``cap_max`` alone.
        absgrad: uses absolute per-pixel gradients (AbsGS); wants a threshold about four times larger.

    Raises:
        ValueError: an option is out of its range.
    """

    milestones, intervals = ("start", "stop"), ("every", "reset_every")

    def __init__(
        self,
        start: int = 500,
        stop: int = 15_000,
        every: int = 100,
        grad_threshold: float = 2e-4,
        duplicate_scale: float = 0.01,
        prune_opacity: float = 0.005,
        prune_scale: float = 0.1,
        reset_every: int | None = 3000,
        reset_opacity: float = 0.01,
        cap_max: float = 100_000,
        multiple: float | None = None,
        absgrad: bool = False,
    ) -> None:
        if every < 1 or cap_max < 1 or (reset_every is not None and reset_every < 1):
            raise ValueError(
                f"density.every, reset_every and cap_max must be at least 1, got {every}, {reset_every}, {cap_max}"
            )
        if multiple is not None and not 0 < multiple < math.inf:
            raise ValueError(f"density.multiple must be above 0 and finite, or null, got {multiple}")
        if not 0 < reset_opacity < 1:
            raise ValueError(f"density.reset_opacity must lie in (0, 1), got {reset_opacity}")
        if min(start, stop, grad_threshold, duplicate_scale, prune_opacity, prune_scale) < 0:
            raise ValueError(
                "density.start, stop, grad_threshold, duplicate_scale, prune_opacity and prune_scale must not be negative, got "
                f"{start}, {stop}, {grad_threshold}, {duplicate_scale}, {prune_opacity} and {prune_scale}"
            )
        self.start, self.stop, self.every = start, stop, every
        self.grad_threshold, self.duplicate_scale = grad_threshold, duplicate_scale
        self.prune_opacity, self.prune_scale = prune_opacity, prune_scale
        self.reset_every, self.reset_opacity = reset_every, reset_opacity
        self.cap_max, self.absgrad = cap_max, absgrad
        self.multiple = multiple

    def initial_state(self, count: int, device: torch.device) -> dict[str, Tensor]:
        """ "gradient" [N], the sum of gradient norms, and "seen" [N], the number of views that saw the Gaussian."""
        return {"gradient": torch.zeros(count, device=device), "seen": torch.zeros(count, device=device)}

    def absgrad_at(self, step: int) -> bool:
        return self.absgrad and step < self.stop

    @torch.no_grad()
    def observe(self, state: dict[str, Tensor], output: RenderOutput, camera: Camera, step: int) -> None:
        if step >= self.stop:
            return
        pull, ids = ndc_gradient_norms(output, camera, self.absgrad), output.meta["visible_ids"]
        if pull is None:
            return
        state["gradient"].index_add_(0, ids, pull.to(state["gradient"]))
        state["seen"].index_add_(0, ids, torch.ones_like(ids, dtype=state["seen"].dtype))

    @torch.no_grad()
    def refine(self, cloud: Cloud, step: int, extent: float, generator: torch.Generator) -> DensityChange | None:
        added = removed = 0
        due = self.start <= step < self.stop and self._comes("every", step)
        if due:
            added = self._grow(cloud, extent, generator)
            removed = self._prune(cloud, step, extent)
            for statistic in cloud.state.values():
                statistic.zero_()
        reset = 0 < step + 1 == self._last_reset(step) and not cloud.is_held("opacity_logits")
        if reset:
            cloud.lower_opacities(self.reset_opacity)
        return DensityChange(added, removed, reset) if due or reset else None

    def settled(self, step: int) -> bool:
        last = self._last_reset(step)
        return last <= 0 or step + 1 - last >= RECOVERY * self.every

    def _last_reset(self, step: int) -> int:
        """Steps after which opacities were reset last, up to ``step`` + 1; 0 before the first."""
        if self.reset_every is None:
            return 0
        last = min(step + 1, self.stop - 1, self.opacities_until - RECOVERY * self.every)
        number = self._times_come("reset_every", last)
        return self._comes_after("reset_every", number) if number > 0 else 0

    def _visible(self, opacities: Tensor) -> Tensor:
        """Which Gaussians [N] of opacities [M, N] need not be pruned as transparent."""
        return (opacities > self.prune_opacity).any(dim=0)

    def _grow(self, cloud: Cloud, extent: float, generator: torch.Generator) -> int:
        pull = cloud.state["gradient"] / cloud.state["seen"].clamp(min=1)
        large = cloud.splats.scales.amax(dim=1) > self.duplicate_scale * extent
        return self._multiply(cloud, pull, pull > self.grad_threshold, large, generator)

    def _room(self, cloud: Cloud) -> int:
        """How many Gaussians may still come."""
        most = self.cap_max if self.multiple is None else min(round(self.multiple * self.initial_count), self.cap_max)
        return max(0, most - len(cloud))

    def _multiply(self, cloud: Cloud, pull: Tensor, grow: Tensor, large: Tensor, generator: torch.Generator) -> int:
        """Duplicates those of ``grow`` that are not ``large`` and splits the others; under the cap, strongest pull first."""
        room = self._room(cloud)
        if int(grow.sum()) > room:  # one more Gaussian each, whether it is duplicated or split
            strongest = torch.where(grow, pull, -torch.inf).argsort(descending=True, stable=True)[:room]
            grow = torch.zeros_like(grow)
            grow[strongest] = True
        duplicates, splits = (grow & ~large).nonzero().squeeze(1), (grow & large).nonzero().squeeze(1)
        if len(duplicates):
            cloud.append(cloud.rows(duplicates))
        if len(splits):
            halves = self._halves(cloud, splits, generator)
            keep = torch.ones(len(cloud), dtype=torch.bool, device=pull.device)
            keep[splits] = False
            cloud.keep(keep)
            cloud.append(halves)
        return len(duplicates) + len(splits)

    @staticmethod
    def _halves(cloud: Cloud, ids: Tensor, generator: torch.Generator) -> dict[str, Tensor]:
        """Two Gaussians for each of ``ids``, drawn from it and smaller by 1.6; everything else is inherited."""
        rows = {name: tensor.repeat(2, *[1] * (tensor.ndim - 1)) for name, tensor in cloud.rows(ids).items()}
        draw = torch.randn(rows["means"].shape, generator=generator, dtype=rows["means"].dtype).to(rows["means"].device)
        rotations = quats_to_matrices(rows["quats"])
        rows["means"] += torch.einsum("nij,nj->ni", rotations, draw * rows["log_scales"].exp())
        rows["log_scales"] -= torch.log(torch.tensor(SPLIT_SHRINK)).item()
        return rows

    def _prune(self, cloud: Cloud, step: int, extent: float) -> int:
        keep = self._visible(cloud.splats.opacities)
        if self._last_reset(step - 1) > 0:
            keep &= cloud.splats.scales.amax(dim=1) <= self.prune_scale * extent
        keep &= torch.isfinite(cloud.splats.means).all(dim=1)
        return cloud.prune(
            keep,
            f"density control would prune all {len(cloud)} Gaussians at step {step}: each has an opacity below "
            f"{self.prune_opacity}. Lower the learning rates or density.prune_opacity, or start from more points.",
        )
