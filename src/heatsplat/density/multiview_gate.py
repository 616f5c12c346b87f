"""Growth only where several views are wrong, and late pruning of what they blame: the rule of FastGS, made scale-free."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import Camera, RenderOutput, SceneData, SceneError, quantile
from heatsplat.density.adaptive import Adaptive
from heatsplat.density.base import DensityChange, ndc_gradient_norms
from heatsplat.density.ops import Cloud
from heatsplat.physics.noise import noise_of_views

LEAST_VIEWS = 8  # of a scene; FastGS fails where views are few (28 of them: 17 dB)
WRONG = 0.1  # an error above this share of the largest of its image is wrong (FastGS)
LARGEST = 0.995  # quantile of the errors of an image that counts as the largest (ours: one hot pixel must not decide)
NOISES = 3.0  # errors up to this many standard deviations of the sensor's noise are not wrong (ours)
SEEN_WRONG = 1.0  # pixels: what a view must have wrong of a Gaussian to count as one that blames it (ours)


class MultiviewGate(Adaptive):
    """Adaptive density control behind a gate: a Gaussian may grow that shows wrong pixels in several views.

    A pixel is wrong whose error is above a tenth of the largest in its image and above the noise of the sensor. Before
    every refinement, ``views`` different views say how many wrong pixels each Gaussian has: Σ_p M_p w_ip, its blending
    weights on them, summed in the ordinary backward pass of the last training steps. FastGS counts the pixels that it
    touches instead, w or not, in renders made for that; counts cannot be had of every renderer. Each view is one of a
    training step, seen at its own time and with the Gaussians of that step.

    Of those that pass, the ones grow whose screen position pulls most: small ones are duplicated by the norm of their
    gradient and large ones split by the norm of its absolute values, each above a quantile over the Gaussians seen.

    After growth, Gaussians go that are faint or that are blamed most, by blame = Σ_v (mean error of view v) Σ_p M_p w_ip.

    Left out of FastGS: the ceiling on opacities after growth, the sampled pruning of transparent Gaussians (they all go)
    and radii in pixels.

    Args:
        views: V, views that say which pixels are wrong; all of them where the scene has fewer.
        gate_pixels: wrong pixels per view, averaged over the V views, above which a Gaussian passes. None: all pass.
        gate_views: and in at least this many of them.
        grad_quantile: quantile of the gradients above which Gaussians grow.
        late_every, late_stop: steps between late prunings, counted from ``stop``, and the step from which on there are none.
        late_opacity: late pruning removes Gaussians up to this opacity in every modality. None: none for that.
        late_blame: and those above this blame, which is scaled to [0, 1] over the Gaussians. None: none for that.
        late_share: one late pruning removes at most this share of the Gaussians; the blamed go first, then the faintest.
        adaptive: the options of ``Adaptive`` but absgrad and grad_threshold.

    Raises:
        ValueError: an option is out of its range.

    Source: FastGS (CVPR 2026), multi-view consistent densification and pruning.
    """

    milestones, intervals = (*Adaptive.milestones, "late_stop"), (*Adaptive.intervals, "late_every")

    def __init__(
        self,
        views: int = 10,
        gate_pixels: float | None = 2.0,
        gate_views: int = 2,
        grad_quantile: float = 0.85,
        late_every: int = 3000,
        late_stop: int = 27_000,
        late_opacity: float | None = 0.1,
        late_blame: float | None = 0.9,
        late_share: float = 0.2,
        **adaptive: Any,
    ) -> None:
        super().__init__(**adaptive, absgrad=True)
        if not 1 <= gate_views <= views or 2 * views > min(self.every, late_every):
            raise ValueError(
                f"density.views must be at least gate_views, and at most half of density.every and late_every, got {views} "
                f"views, gate_views {gate_views}, every {self.every}, late_every {late_every}"
            )
        if not 0 < grad_quantile < 1 or not 0 <= late_share <= 1:
            raise ValueError(
                f"density.grad_quantile lies in (0, 1) and late_share in [0, 1], got {grad_quantile}, {late_share}"
            )
        given = [number for number in (gate_pixels, late_opacity, late_blame) if number is not None]
        if min((late_stop, *given)) < 0:
            raise ValueError(
                "density.late_stop, gate_pixels, late_opacity and late_blame must not be negative, got "
                f"{late_stop}, {gate_pixels}, {late_opacity} and {late_blame}"
            )
        self.views, self.gate_pixels, self.gate_views = views, gate_pixels, gate_views
        self.grad_quantile, self.shortest = grad_quantile, 2 * views
        self.late_every, self.late_stop = late_every, late_stop
        self.late_opacity, self.late_blame, self.late_share = late_opacity, late_blame, late_share
        self.noise = 0.0
        self._count = views  # of training views
        self._mean_error = 0.0  # of the image of this step

    def prepare(self, scene: SceneData, modality: str) -> None:
        """Takes the noise of the training images and their number.

        Raises:
            SceneError: there are too few of them.
        """
        self._count = len(scene.train)
        if self._count < LEAST_VIEWS:
            raise SceneError(
                f"density=multiview_gate asks several views what is wrong, and scene '{scene.name}' has {self._count} for "
                f"training; it needs {LEAST_VIEWS}. Use density=adaptive."
            )
        self.views = min(self.views, self._count)
        self.noise = noise_of_views(scene.train, modality)

    def initial_state(self, count: int, device: torch.device) -> dict[str, Tensor]:
        """ "gradient", "absolute" and "seen" [N], over all views; "wrong", "blame" and "blaming" [N], over the V views."""
        names = ("absolute", "wrong", "blaming", "blame")
        return super().initial_state(count, device) | {name: torch.zeros(count, device=device) for name in names}

    def maps_at(self, step: int) -> int:
        used = self.gate_pixels if self._grows(step) else self.late_blame
        return int(used is not None and self._asks(step))

    def _asks(self, step: int) -> bool:
        """Whether the view of ``step`` is one of the V that are asked before the next refinement.

        They are the last V, moved back to the end of a pass over all views where they would reach into the next: within a
        pass no view comes twice.
        """
        event = self._next(step)
        if event is None:
            return False
        over = event % self._count
        last = event if over == 0 or over >= self.views else event - over
        return last - self.views <= step < last

    def _grows(self, step: int) -> bool:
        """Whether the next refinement is one of growth, not a late pruning."""
        return step < self._comes_after("every", self._times_come("every", self.stop))

    def _next(self, step: int) -> int | None:
        """Steps that are done at the next refinement, that of ``step`` included; None after the last."""
        if self._grows(step):
            return self._comes_after("every", self._times_come("every", max(step, self.start)) + 1)
        event = self.stop + max(-(-(step + 1 - self.stop) // self.late_every), 1) * self.late_every
        return event if event <= self.late_stop else None

    @torch.no_grad()
    def pixel_maps(self, error: Tensor, target: Tensor, step: int) -> Tensor:
        counted = error[~target.isnan().any(dim=-1)]
        self._mean_error = (
            float(counted.mean()) if len(counted) else 0.0
        )  # for ``observe``, which follows in the same step
        largest = quantile(counted, LARGEST) if len(counted) else error.new_zeros(())
        return (error > (WRONG * largest).clamp(min=NOISES * self.noise))[..., None].to(error)

    @torch.no_grad()
    def observe(self, state: dict[str, Tensor], output: RenderOutput, camera: Camera, step: int) -> None:
        ids = output.meta["visible_ids"]
        if self._grows(step) and output.meta["means2d"].grad is not None:
            for name, absolute in (("gradient", False), ("absolute", True)):
                state[name].index_add_(0, ids, ndc_gradient_norms(output, camera, absolute).to(state[name]))
            state["seen"].index_add_(0, ids, torch.ones_like(ids, dtype=state["seen"].dtype))
        if output.weighted is not None:
            wrong = output.weighted.sums[:, 0].to(state["wrong"])
            state["wrong"].index_add_(0, ids, wrong)
            state["blaming"].index_add_(0, ids, (wrong >= SEEN_WRONG).to(wrong))
            state["blame"].index_add_(0, ids, self._mean_error * wrong)

    @torch.no_grad()
    def refine(self, cloud: Cloud, step: int, extent: float, generator: torch.Generator) -> DensityChange | None:
        late = self.stop < step + 1 <= self.late_stop and (step + 1 - self.stop) % self.late_every == 0
        if not late:
            return super().refine(cloud, step, extent, generator)
        # Where opacities are held still, others could not make up for those that go.
        removed = 0 if cloud.is_held("opacity_logits") else self._prune_late(cloud)
        for statistic in cloud.state.values():
            statistic.zero_()
        return DensityChange(removed=removed)

    def _grow(self, cloud: Cloud, extent: float, generator: torch.Generator) -> int:
        seen = cloud.state["seen"] > 0
        if not seen.any():
            return 0
        large = cloud.splats.scales.amax(dim=1) > self.duplicate_scale * extent
        pull = torch.where(large, self._relative(cloud, "absolute", seen), self._relative(cloud, "gradient", seen))
        return self._multiply(cloud, pull, (pull > 1) & seen & self._passes(cloud.state), large, generator)

    def _relative(self, cloud: Cloud, name: str, seen: Tensor) -> Tensor:
        """Mean of a gradient over the views that saw a Gaussian [N], in units of its quantile over the Gaussians."""
        mean = cloud.state[name] / cloud.state["seen"].clamp(min=1)
        return mean / quantile(mean[seen], self.grad_quantile).clamp(min=torch.finfo(mean.dtype).tiny)

    def _passes(self, state: dict[str, Tensor]) -> Tensor:
        """Which Gaussians pass the gate, [N] bool."""
        if self.gate_pixels is None:
            return torch.ones_like(state["wrong"], dtype=torch.bool)
        return (state["wrong"] > self.gate_pixels * self.views) & (state["blaming"] >= self.gate_views)

    def _prune_late(self, cloud: Cloud) -> int:
        opacities, blame = cloud.splats.opacities.amax(dim=0), cloud.state["blame"]
        faint = torch.zeros_like(blame, dtype=torch.bool)
        if self.late_opacity is not None:
            faint = opacities <= self.late_opacity
        blamed = torch.zeros_like(faint)
        if self.late_blame is not None and blame.amax() > blame.amin():
            blamed = (blame - blame.amin()) / (blame.amax() - blame.amin()) > self.late_blame
        order = (opacities - blamed.to(opacities)).argsort(stable=True)
        gone = order[(faint | blamed)[order]][: int(self.late_share * len(cloud))]
        keep = torch.ones_like(faint)
        keep[gone] = False
        return cloud.prune(
            keep,
            f"late pruning would remove all {len(cloud)} Gaussians: each has an opacity up to {self.late_opacity} or a blame "
            f"above {self.late_blame}. Lower density.late_share.",
        )
