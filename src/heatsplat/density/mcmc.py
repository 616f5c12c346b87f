"""3DGS as Markov chain Monte Carlo: dead Gaussians move onto living ones, centres wander, and the number is exact."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from heatsplat.contracts import SceneError
from heatsplat.density.base import DensityChange, DensityControl
from heatsplat.density.ops import Cloud
from heatsplat.geometry.rotations import quats_to_matrices
from heatsplat.same_bits import sigmoid

SHARPNESS = 100.0  # per opacity: how fast noise fades above ``dead_opacity`` (authors' code)
STILL = 1e-6  # Gaussians whose noise has faded to this share are left alone (ours): those of opacities above 0.143
MOST = 51  # Gaussians in one place at most (authors' code)
OPAQUE = 1.0 - 1e-7  # largest opacity that is taken apart


class MCMC(DensityControl):
    """Relocates Gaussians that have become transparent, grows by a fixed share up to the cap, and lets centres wander.

    Where n Gaussians come to lie in the place of one, their opacity and size are such that together they hide and shine as
    that one did (``stacked``), and all else, heat included, is copied; their moments start at zero. In which place is drawn
    with probability proportional to opacity.

    After every step a centre moves by Σ η · lr · noise · sigmoid(100 (dead_opacity - opacity)), η normal and lr the
    learning rate of centres in that step, lengths in extents of the scene: transparent Gaussians explore, others stay.

    Of several opacities (modalities) the largest counts for death, draw, size and noise; each is taken apart by itself.

    The loss needs its penalties on opacity and size (``losses.transparency``, which ``density=mcmc`` adds): without them
    nothing dies.

    Args:
        start, stop: first and last step at which Gaussians are relocated and added.
        every: steps between that.
        growth: share of the Gaussians that is added each time.
        cap_max: never more Gaussians than this, which it grows to: finite.
        dead_opacity: Gaussians up to this opacity are relocated.
        noise: factor on the learning rate of centres. 0: centres do not wander.

    Raises:
        ValueError: an option is out of its range.

    Source: Kheradmand et al. 2024, 3D Gaussian Splatting as Markov Chain Monte Carlo, Eq. 8-10.
    """

    milestones, intervals = ("start", "stop"), ("every",)

    def __init__(
        self,
        start: int = 500,
        stop: int = 25_000,
        every: int = 100,
        growth: float = 0.05,
        cap_max: int = 100_000,
        dead_opacity: float = 0.005,
        noise: float = 5e5,
    ) -> None:
        if every < 1 or cap_max < 1 or min(start, stop, growth, dead_opacity, noise) < 0:
            raise ValueError(
                "density.every and cap_max must be at least 1, start, stop, dead_opacity, growth and noise at least 0, got "
                f"{every}, {cap_max}, {start}, {stop}, {dead_opacity}, {growth}, {noise}"
            )
        if not math.isfinite(cap_max):
            raise ValueError(
                "density=mcmc grows to density.cap_max, which must be finite: set cap_max, as in cap_max=100000"
            )
        self.start, self.stop, self.every = start, stop, every
        self.growth, self.cap_max, self.dead_opacity, self.noise = growth, cap_max, dead_opacity, noise

    @torch.no_grad()
    def refine(self, cloud: Cloud, step: int, extent: float, generator: torch.Generator) -> DensityChange | None:
        trained = not cloud.is_held("means")
        change = None
        if self.start <= step < self.stop and self._comes("every", step):
            change = self._relocate(cloud, step, generator)
        if self.noise > 0 and trained:
            self._wander(cloud, extent, generator)
        return change

    def _relocate(self, cloud: Cloud, step: int, generator: torch.Generator) -> DensityChange:
        """Removes the dead, and puts as many and those that are to be added where others live."""
        opacities = cloud.splats.opacities.amax(dim=0)
        finite = torch.isfinite(cloud.splats.means).all(dim=1)
        alive = (opacities > self.dead_opacity) & finite
        before, living = len(cloud), int(alive.sum())
        if living == 0:
            raise SceneError(
                f"density control finds all {before} Gaussians dead at step {step}: each has an opacity up to "
                f"{self.dead_opacity}. Lower the learning rates or the penalty on opacities, or start from more points."
            )
        wanted = max(min(self.cap_max, int((1 + self.growth) * before)), living)
        copies = _draw(torch.where(alive, opacities, 0.0), wanted - living, generator)
        chosen = (copies > 0).nonzero().squeeze(1)
        if len(chosen):
            rows = self._stack(cloud, chosen, copies[chosen] + 1)
            cloud.keep(alive & (copies == 0))
            cloud.append(rows)
        elif living < before:
            cloud.keep(alive)
        return DensityChange(added=max(len(cloud) - before, 0), removed=max(before - len(cloud), 0))

    def _stack(self, cloud: Cloud, ids: Tensor, counts: Tensor) -> dict[str, Tensor]:
        """Rows of ``counts`` [n] Gaussians in the place of each of ``ids`` [n]."""
        rows = cloud.rows(ids)
        opacities = sigmoid(rows["opacity_logits"].double()).clamp(max=OPAQUE)
        several, _ = stacked(opacities, counts[:, None])
        _, shrink = stacked(opacities.amax(dim=1), counts)
        rows["log_scales"] += shrink.log()[:, None].to(rows["log_scales"])
        rows["opacity_logits"] = torch.logit(several).to(rows["opacity_logits"])
        return {name: tensor.repeat_interleave(counts, dim=0) for name, tensor in rows.items()}

    def _wander(self, cloud: Cloud, extent: float, generator: torch.Generator) -> None:
        splats = cloud.splats
        rate = next(group["lr"] for group in cloud.optimizer.param_groups if group["name"] == "means")
        share = sigmoid(SHARPNESS * (self.dead_opacity - splats.opacities.amax(dim=0)))
        ids = (share > STILL).nonzero().squeeze(1)
        draw = torch.randn((len(ids), 3), generator=generator, dtype=splats.means.dtype).to(splats.means.device)
        axes = quats_to_matrices(splats.quats[ids])
        along = torch.einsum("nji,nj->ni", axes, draw) * (splats.scales[ids] / extent).square()
        moves = torch.einsum("nij,nj->ni", axes, along)
        splats.means[ids] += rate * self.noise * share[ids, None] * moves


def stacked(opacities: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity, and factor on the size, of each of n Gaussians in one place that together act as one of the given opacity.

    In the centre of their image they hide as much: 1 - (1 - a)^n = o. Along any line across it, what they hide adds up to
    the same: f Σ_k C(n, k) (-1)^(k-1) a^k / √k = o, k from 1 to n. Both of any shape that broadcasts.

    Args:
        opacities: o, float64, below 1.
        counts: n; above ``MOST`` it is taken for that.

    Source: 3DGS-MCMC (Kheradmand et al. 2024, Eq. 9), whose double sum of binomials is one over k.
    """
    counts = counts.clamp(max=MOST).to(opacities)
    each = -torch.expm1(torch.log1p(-opacities) / counts)
    total = torch.zeros_like(each)
    term = -torch.ones_like(each)  # C(n, k) (-a)^k, with its sign turned
    for k in range(1, int(counts.max()) + 1 if counts.numel() else 1):
        term = term * (-each) * ((counts - k + 1).clamp(min=0) / k)
        total = total + term / math.sqrt(k)
    return each, opacities / total


def _draw(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """How often each of [N] was drawn in ``count`` draws with probability proportional to ``weights``, [N] int64."""
    summed = weights.double().cpu().cumsum(0)
    places = torch.searchsorted(
        summed, summed[-1] * torch.rand(count, generator=generator, dtype=torch.float64), right=True
    )
    return torch.bincount(places.clamp(max=len(weights) - 1), minlength=len(weights)).to(weights.device)
