"""Density control to a budget: Gaussians are split along their longest axis where images are wrong, exactly to B of them."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from scipy.ndimage import distance_transform_edt, gaussian_laplace
from torch import Tensor

from heatsplat.contracts import Camera, RenderOutput, SceneData, check_option
from heatsplat.density.base import DensityChange, DensityControl, ndc_gradient_norms
from heatsplat.density.ops import Cloud, LongAxisSplit
from heatsplat.physics.noise import MIN_NOISE, noise_of_views

log = logging.getLogger(__name__)

CURVES: dict[str, Callable[[float], float]] = {
    "sqrt": lambda x: x**0.5,
    "linear": lambda x: x,
    "concave": lambda x: 2 * x - x * x,
}
SCORES = ("both", "error", "edge", "absgrad", "uniform")
BLUR = 1.5  # pixels: standard deviation of the Gaussian under which edges are looked for; noise has weaker ones
BY_CHANCE = 0.01  # of a Gaussian's pixels, noise alone lifts fewer above three of its standard deviations (0.27 %)
OF_PIXELS = ("weight", "wrong", "worth")  # what maps over pixels are summed into, in their order
FOR_REMOVAL = ("shown", "seen", "judged")  # pixels on which a Gaussian shows, views that show it, views that could have
DIM = 0.01  # of all that a view shows, the Gaussians that contribute least and together no more than this are not seen in it


class Budget(DensityControl):
    """Splits where the image is wrong until there are exactly B Gaussians, and removes those that show nothing.

    B is ``cap_max`` or, where that is less, ``multiple`` times the Gaussians of the start. A start of few Gaussians says
    little of what a scene needs: B is at least ``least``, or one for two pixels of a training image where that is less.

    The score of a Gaussian is the product of two sums over the last ``views`` steps before an event (the sampler shows each
    view once a pass). One says how wrong its pixels are: their errors beyond the noise of the camera, weighted by how much of
    each pixel it is, Σ_v Σ_p w max(e - floor noise, 0). The other says how much that changes with its place on the screen x:
    how hard single pixels pull there, Σ_v |Σ_p |∂L/∂x||. Those with the highest scores are split, and only those that are
    wrong on enough pixels for that not to be noise. Of the Gaussians that are still missing, an event adds the share that
    its part of ``curve`` has of what is left of the curve; so their number follows N0 + (B - N0) curve(x), catches up with
    what was removed or held back, and is B after the last event if enough of them are wrong.

    Once they have come, Gaussians leave that the training views hardly show: after the first whole pass of the views that
    begins at a step of ``remove_at`` or later, those outside the share ``keep`` of all blending weights, and those seen in
    fewer than two of several views. Where there are so many views that this pass would end after ``remove_by``, it is the last
    pass that ends by then, and what was split in it stays; a step of ``remove_at`` after ``remove_by`` removes none. Nothing is
    added after ``stop``, and opacities are never reset.

    Blending weights are those on pixels that count: what only masked pixels show is shown by no view. With several modalities,
    errors are those of all images and blending weights those of the first; what another modality shows is never removed.

    After Taming 3DGS (Mallick et al. 2024: budget, concave curve), Revising Densification (Bulo et al. 2024: error by
    blending weights), AbsGS (Ye et al. 2024: pull), Improved-GS (2025: long-axis split, root curve) and Mini-Splatting2
    (2024: removal).

    Args:
        start, stop: first and last step at which Gaussians are added, or removed as transparent.
        every: steps between events.
        cap_max: never more Gaussians than this.
        multiple: B in Gaussians of the start; None: B is ``cap_max``.
        least: B of images of any size where the start has few Gaussians.
        score: "both", "error", "edge" (the Laplacian of the blurred training images, in place of the error: Improved-GS),
            "absgrad" (the pull: AbsGS) or "uniform" (any of them alike).
        sampled: those to be split are drawn by score, without replacement, in place of the highest (Taming 3DGS); "uniform"
            draws in any case.
        curve: "sqrt", "linear" or "concave", of the share x of the events that are done.
        views: steps before an event over which the score is summed.
        floor: errors up to so many standard deviations of the noise do not count; 0 counts all.
        noise: that standard deviation in image units; None estimates it from the training images.
        least_pixels: Gaussians wrong on fewer pixels than this, as training renders them (``supersample``), over all views of the
            score, are not split.
        prune_opacity: Gaussians below this opacity (in every modality) are removed at events.
        remove_at: steps from which on a pass of the views tells which Gaussians they hardly show; those leave after it.
        remove_by: last step of such a pass, so that the others can settle; shorter than a pass, none are removed so.
        keep: share of all blending weights that stays.
        split: how a Gaussian is split.

    Raises:
        ValueError: an option is out of its range.
    """

    milestones, intervals = ("start", "stop", "remove_at", "remove_by"), ("every",)

    def __init__(
        self,
        start: int = 600,
        stop: int = 14_400,
        every: int = 500,
        cap_max: int = 100_000,
        multiple: float | None = 3.0,
        least: int = 10_000,
        score: str = "both",
        sampled: bool = False,
        curve: str = "linear",
        views: int = 10,
        floor: float = 3.0,
        noise: float | None = None,
        least_pixels: float = 3.0,
        prune_opacity: float = 0.005,
        remove_at: Sequence[int] = (14_400,),
        remove_by: int = 27_000,
        keep: float = 0.999,
        split: LongAxisSplit | None = None,
    ) -> None:
        check_option("density.score", score, SCORES)
        check_option("density.curve", curve, CURVES)
        if min(every, cap_max, views) < 1:
            raise ValueError(f"density.every, cap_max and views must be at least 1, got {every}, {cap_max} and {views}")
        if (multiple is not None and not 0 < multiple < math.inf) or least < 0:
            raise ValueError(
                "density.multiple must be above 0 and finite, or null, and least not negative, got "
                f"{multiple} and {least}"
            )
        if multiple is None and math.isinf(cap_max):
            raise ValueError(
                "density=budget grows to a number that cap_max=inf with density.multiple=null leaves open: give one of them"
            )
        if not 0 < keep <= 1 or min(floor, least_pixels, noise or 0.0) < 0:
            raise ValueError(
                "density.keep lies in (0, 1], and floor, noise and least_pixels are not negative, "
                f"got {keep}, {floor}, {noise} and {least_pixels}"
            )
        if min(start, stop, prune_opacity, remove_by, *remove_at) < 0:
            raise ValueError(
                "density.start, stop, prune_opacity, remove_at and remove_by must not be negative, "
                f"got {start}, {stop}, {prune_opacity}, {list(remove_at)} and {remove_by}"
            )
        self.start, self.stop, self.every, self.cap_max = start, stop, every, cap_max
        self.multiple, self.least = multiple, least
        self.score, self.curve, self.views = score, CURVES[curve], min(views, every)
        self.sampled = sampled or score == "uniform"
        self._of_pixels, self._of_pull = score in ("both", "error", "edge"), score in ("both", "absgrad")
        self.floor, self.noise, self.least_pixels = floor, noise, least_pixels
        self.prune_opacity, self.keep = prune_opacity, keep
        self.remove_at, self.remove_by = tuple(remove_at), remove_by
        self.split = split or LongAxisSplit()
        self.steps_of_pass = 1
        self._first = start // every  # event of growth, by its number, which a plan that is moved leaves as it is

    def prepare(self, scene: SceneData, modality: str) -> None:
        """Takes the number of training views, their pixels and, unless given, their noise (that of the first modality)."""
        self.steps_of_pass = len(scene.train)
        if late := [begin for begin in self.remove_at if begin > self.remove_by]:
            log.warning(
                "density.remove_at=%s begins after density.remove_by=%d, by which a pass has to end: none is removed so. Raise "
                "the latter, or leave this step out", late, self.remove_by,
            )  # fmt: skip
        pixels = min(frame.camera.width * frame.camera.height for frame in scene.train.frames)
        self.least = min(self.least, pixels // 2)
        if self.noise is None and self.floor > 0:
            self.noise = noise_of_views(scene.train, modality)
            if self.noise <= MIN_NOISE:
                log.warning(
                    "neighbouring pixels of scene '%s' are equal, so its noise is unknown and every error counts for density "
                    "control; give density.noise in image units (a third of a quantisation step at least)",
                    scene.name,
                )

    def initial_state(self, count: int, device: torch.device) -> dict[str, Tensor]:
        """What was summed since the last event, each [count]: for growth, as far as the score asks, "pull", "weight" and "wrong"
        (pixels) and "worth" (errors or edges); FOR_REMOVAL for removal. Pixels are those that count."""
        return {name: torch.zeros(count, device=device) for name in (*self._summed, *FOR_REMOVAL)}

    @property
    def _summed(self) -> tuple[str, ...]:
        """Names of what is summed for growth."""
        return (("pull",) if self._of_pull else ()) + (OF_PIXELS if self._of_pixels else ())

    @property
    def budget(self) -> float:
        """B, the number of Gaussians after the last event."""
        if self.multiple is None:
            return self.cap_max
        return min(max(round(self.multiple * self.initial_count), self.least), self.cap_max)

    # When ------------------------------------------------------------------------------------------------------------

    def _event(self, step: int) -> int | None:
        """The event of growth, counted from 0, at or next after a step; None after the last one."""
        number = self._times_come("every", max(step, self.start))
        return number if self._comes_after("every", number + 1) <= self.stop else None

    def _growth_in(self, step: int) -> int | None:
        """Steps from here to the next event of growth, 0 where it is now; None after the last one."""
        number = self._event(step)
        return None if number is None else self._comes_after("every", number + 1) - 1 - step

    def _removal_in(self, step: int) -> int | None:
        """Steps from here to the next removal, 0 where it is now; None after the last one."""
        views = self.steps_of_pass
        last = (self.remove_by + 1) // views * views - 1
        begins = [begin for begin in self.remove_at if begin <= self.remove_by]
        ends = [min((-(-begin // views) + 1) * views - 1, last) for begin in begins]
        return min((end - step for end in ends if end >= step), default=None)

    def _scores(self, step: int) -> bool:
        ahead = self._growth_in(step)
        return ahead is not None and ahead < self.views

    def _judges(self, step: int) -> bool:
        ahead = self._removal_in(step)
        return ahead is not None and ahead < self.steps_of_pass

    # What is gathered ------------------------------------------------------------------------------------------------

    def absgrad_at(self, step: int) -> bool:
        return self._of_pull and self._scores(step)

    def maps_at(self, step: int) -> int:
        """Three while scores are summed (weight, wrong pixels, error or edge), one while only weights are."""
        return len(OF_PIXELS) if self._of_pixels and self._scores(step) else int(self._judges(step))

    def pixel_maps(self, error: Tensor, target: Tensor, step: int) -> Tensor:
        beyond = (error - self.floor * (self.noise or 0.0)).clamp(min=0)
        worth = _edges(target).to(error) if self.score == "edge" and self._scores(step) else beyond
        # What shows only where no pixel counts was never compared with anything.
        known = target.isnan().any(dim=-1).logical_not().to(error)
        maps = torch.stack([known, (beyond > 0).to(error), worth], dim=-1)
        return maps[..., : self.maps_at(step)]

    @torch.no_grad()
    def observe(self, state: dict[str, Tensor], output: RenderOutput, camera: Camera, step: int) -> None:
        ids = output.meta["visible_ids"]
        if self.absgrad_at(step) and (pull := ndc_gradient_norms(output, camera, absolute=True)) is not None:
            state["pull"].index_add_(0, ids, pull.to(state["pull"]))
        if output.weighted is None or output.weighted.sums is None:
            return
        sums = output.weighted.sums.to(state["shown"])
        if self._scores(step) and self._of_pixels:
            for name, column in zip(OF_PIXELS, sums.unbind(1), strict=True):
                state[name].index_add_(0, ids, column)
        if self._judges(step):
            weight = sums[:, 0]
            state["shown"].index_add_(0, ids, weight)
            state["seen"].index_add_(0, ids, _outside(weight, DIM).logical_not().to(weight))
            state["judged"] += 1

    # What is done ----------------------------------------------------------------------------------------------------

    @torch.no_grad()
    def refine(self, cloud: Cloud, step: int, extent: float, generator: torch.Generator) -> DensityChange | None:
        removed = added = 0
        growth, removal = self._growth_in(step) == 0, self._removal_in(step) == 0
        if removal:
            removed += self._prune(cloud, self._worth(cloud), step)
        if growth:
            removed += self._prune(cloud, self._visible(cloud), step)
            added = self._grow(cloud, step, generator)
        for due, names in ((growth, self._summed), (removal, FOR_REMOVAL)):
            for name in names if due else ():
                cloud.state[name].zero_()
        return DensityChange(added, removed) if growth or removal else None

    def _visible(self, cloud: Cloud) -> Tensor:
        opaque = (cloud.splats.opacities > self.prune_opacity).any(dim=0)
        return opaque & torch.isfinite(cloud.splats.means).all(dim=1)

    def _worth(self, cloud: Cloud) -> Tensor:
        """Which Gaussians [N] the training views show, by what was summed over a pass of them, or may show: those of which
        a part of the pass tells nothing, since they were split in it or the plan was moved."""
        seen = cloud.state["seen"] >= min(2, self.steps_of_pass)
        elsewhere = (cloud.splats.opacities[1:] > self.prune_opacity).any(dim=0)
        unknown = cloud.state["judged"] < self.steps_of_pass
        return ~_outside(cloud.state["shown"], 1 - self.keep) & seen | elsewhere | unknown

    def _prune(self, cloud: Cloud, mask: Tensor, step: int) -> int:
        return cloud.prune(
            mask,
            f"density control would remove all {len(cloud)} Gaussians at step {step}: none is more opaque than "
            f"{self.prune_opacity} and shown by the training views. Lower the learning rates or density.prune_opacity, "
            "or start from more points.",
        )

    def _grow(self, cloud: Cloud, step: int, generator: torch.Generator) -> int:
        wanted = round(self._share(step) * max(self.budget - len(cloud), 0))
        chosen = _best(self._scored(cloud.state), wanted, generator if self.sampled else None)
        cloud.split(chosen, self.split)
        return len(chosen)

    def _scored(self, state: dict[str, Tensor]) -> Tensor:
        """Scores of the Gaussians [N], float64, 0 for those that are not to be split."""
        score = torch.ones_like(state["shown"], dtype=torch.float64)
        held_still = self.score == "both" and not state["pull"].any()  # no pixel pulls at centres then
        if self._of_pull and not held_still:
            score *= state["pull"]
        if self._of_pixels:
            score *= state["worth"]
        if self.score in ("both", "error"):
            score[state["wrong"] <= self.least_pixels + BY_CHANCE * state["weight"]] = 0
        return score

    def _share(self, step: int) -> float:
        """Of the Gaussians that are missing, the share that comes at the event of this step."""
        first, number = self._first, self._event(step)
        last = self._times_come("every", self.stop) - 1
        before, after = (self.curve((done - first) / (last - first + 1)) for done in (number, number + 1))
        return 1.0 if number == last else (after - before) / (1 - before)


def _edges(image: Tensor) -> Tensor:
    """How strong the edges of an image [H, W, C] are in its pixels, [H, W]: |Laplacian| of its blurred mean over channels.

    Pixels that are NaN have none, and make none: the nearest others stand for them.
    """
    grey = image.mean(-1).cpu().numpy()
    unknown = np.isnan(grey)
    if unknown.all():
        return torch.zeros(grey.shape)
    if unknown.any():
        grey = grey[tuple(distance_transform_edt(unknown, return_distances=False, return_indices=True))]
    return torch.from_numpy(np.where(unknown, 0.0, abs(gaussian_laplace(grey, BLUR))))


def _outside(weights: Tensor, share: float) -> Tensor:
    """The smallest of ``weights`` [n] that together are no more than ``share`` of their sum, [n] bool; zeros are."""
    order = weights.argsort(stable=True)
    small = weights[order].double().cumsum(0) <= share * weights.double().sum()
    return torch.zeros_like(small).scatter_(0, order, small) | (weights <= 0)


def _best(scores: Tensor, count: int, generator: torch.Generator | None) -> Tensor:
    """At most ``count`` different ids, ascending: those of the highest scores, or with a generator each draw by score among
    those left; none without a score."""
    keys = scores.log()
    if generator is not None:
        # The largest keys of log score + Gumbel noise are such a draw (Gumbel-top-k; Efraimidis and Spirakis 2006).
        uniform = torch.rand(scores.shape, generator=generator, dtype=torch.float64).clamp(min=1e-300)
        keys = keys - (-uniform.log()).log().to(scores.device)
    count = min(count, int((scores > 0).sum()))
    return keys.argsort(descending=True, stable=True)[:count].sort().values
