"""Merging flat neighbours after training, until a stated number of degrees is lost (the idea of NanoGS, on temperatures)."""

from __future__ import annotations

import copy
import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import Frame, SceneError, evenly_spread
from heatsplat.density.base import Merging
from heatsplat.density.moment_matching import Merged, Shapes, merged
from heatsplat.density.ops import Cloud
from heatsplat.geometry.neighbours import neighbour_pairs
from heatsplat.splats import GEOMETRY, Splats

log = logging.getLogger(__name__)

UNSEEN = 0.05  # weight of a Gaussian that no view shows, in medians of those that are seen
FEWEST = 0.005  # share of the Gaussians below which a round is not worth its renders
STRICT = 0.999  # quantile of the differences that is reported beside their root mean square
STEP = 0.4  # share of what may still be lost that a round may lose
DEARER = 4.0  # factor on the price of Gaussians whose pair was taken apart again
WEIGHT, CHANGE = "weight", "change"  # statistics of the cloud that is worked on: see _weigh
PAIRS = 1 << 15  # that are priced together: what is worked out of each takes 2 KB
VIEWS = 16  # that are compared together, for every change of what is shown may cost a look at all cameras
TOLD_SECONDS = 15.0  # between two lines that say how far merging is
ORIGIN = "origin"  # statistic of the cloud that is worked on: 1 + place before merging, 0 for merged Gaussians


@dataclass(frozen=True)
class Level:
    """Gaussians that were merged as far as a tolerance allowed.

    Args:
        splats: what is left.
        origin: [n] place of each before merging, -1 for those that are merged.
        found: what came of it, for the report.
    """

    splats: Splats
    origin: Tensor
    found: dict[str, Any]

    def apply(self, cloud: Cloud) -> None:
        """Merges the Gaussians of the cloud that was merged; what stays keeps its optimiser moments, the merged have none."""
        keep = torch.zeros(len(cloud), dtype=torch.bool, device=cloud.splats.means.device)
        keep[self.origin[self.origin >= 0]] = True
        cloud.keep(keep)
        cloud.append(Cloud(self.splats).rows((self.origin < 0).nonzero().squeeze(1)))


class FlatMerging(Merging):
    """Merges pairs of neighbours, those that change the images least first, until the training views show the loss.

    In every round each Gaussian looks at its nearest neighbours. The price of a pair is the expected squared change of the
    images: how far its temperatures are from those of the merged one, times the squared blending weights of both, and how far
    its alpha is, times the squared change of the images with their opacities (small where what lies behind has the same
    temperature). Weights and changes come from a backward pass of random signs through every view. Pairs that are each
    other's cheapest are merged for a trial. The training views are rendered at their times, what changed is dealt out to the
    merged Gaussians that show there, and the worst are taken apart again.

    Only what agrees at all times is merged: at sampled frames the temperature of the merged one differs from that of either,
    times the opacity of that one, by ``agree_c`` at most. A merged Gaussian has the mean of the parameters, or those of the
    heavier one where that agrees better; constants are always those of the heavier one.

    Args:
        tolerance_c: root mean square of the differences of clean images that may be lost, in °C.
        companion_tolerance: the same for images of companions, in image units.
        agree_c: largest difference, times opacity, in °C; for companions in the same proportion to their tolerance.
        share: of the Gaussians that are merged into others in a round, at most.
        neighbours: that a Gaussian looks at.
        views: training views on which the loss is measured, evenly spread; null for all.
        times: frames at which temperatures are compared, evenly spread over the record.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(
        self,
        tolerance_c: float = 0.02,
        companion_tolerance: float = 0.004,
        agree_c: float = 1.0,
        share: float = 0.2,
        neighbours: int = 8,
        views: int | None = 128,
        times: int = 8,
    ) -> None:
        if not (tolerance_c > 0 and companion_tolerance > 0 and agree_c > 0 and 0 < share <= 0.5):
            raise ValueError(
                "merge.tolerance_c, companion_tolerance and agree_c must be positive and share in (0, 0.5], got "
                f"{tolerance_c}, {companion_tolerance}, {agree_c} and {share}"
            )
        if min(neighbours, times) < 1 or (views is not None and views < 1):
            raise ValueError("merge.neighbours, views and times must be at least 1")
        self.tolerance_c, self.companion_tolerance, self.agree_c = tolerance_c, companion_tolerance, agree_c
        self.share, self.neighbours = share, neighbours
        self.views, self.times = views, times

    def check(self, module: Any) -> None:
        if module.thermal.inseparable:
            raise SceneError(
                f"the Gaussians of {type(module.thermal).__name__} cannot be merged: {module.thermal.inseparable}. "
                "Give merge=none"
            )
        if module.scene.range_of(module.modality) is None:
            raise SceneError(
                f"merge.tolerance_c is in °C, and the images of scene '{module.scene.name}' are no temperatures: "
                "give the data set their range, or merge=none"
            )

    def __call__(self, module: Any, cloud: Cloud) -> dict[str, Any]:
        (level,) = self.levels(module, [self.tolerance_c])
        level.apply(cloud)
        return level.found

    @torch.no_grad()
    def levels(self, module: Any, tolerances_c: Sequence[float]) -> Iterator[Level]:
        """Levels of detail, one for each of the increasing tolerances; the module is left as it is.

        Losses are against the module's own images, whatever the level.
        """
        self.check(module)
        since = time.perf_counter()
        search = _Search(self, module)
        for number, tolerance_c in enumerate(tolerances_c):
            search.merge_until(tolerance_c, number)
            found = search.found(tolerance_c) | {"seconds": round(time.perf_counter() - since, 2)}
            log.info(
                "merged: %d Gaussians of %d are left, %.4f °C are lost (root mean square), %.3g s",
                found["after"], found["before"], found["rms_c"], found["seconds"],
            )  # fmt: skip
            yield Level(search.cloud.splats, search.cloud.state[ORIGIN] - 1, found)


@dataclass(frozen=True)
class _Loss:
    """What merging lost: °C of the clean images, and image units of companions by name."""

    rms_c: float
    strict_c: float
    companions: dict[str, float]


class _Search:
    """The Gaussians of a module that are merged, with what the search needs of the module."""

    def __init__(self, options: FlatMerging, module: Any) -> None:
        self.options, self.module = options, module
        self.span_k = module.scene.thermal_range.span_k
        frames = module.scene.train.frames
        self.frames = [frames[i] for i in evenly_spread(len(frames), options.views or len(frames))]
        in_time = sorted(self.frames, key=lambda frame: (frame.time_s or 0.0, frame.frame_id))
        self.sampled_frames = [in_time[i] for i in evenly_spread(len(in_time), options.times)]
        splats = copy.deepcopy(module.splats)
        count = len(splats)
        places = torch.arange(1, count + 1, device=splats.means.device)
        self.cloud = Cloud(splats, state={ORIGIN: places})
        self.before, self.rounds, self.told_at = count, 0, time.monotonic()
        self.wanted = [self._images(frame) for frame in self.frames]
        self.loss = _Loss(0.0, 0.0, dict.fromkeys(module.thermal.companions, 0.0))

    def found(self, tolerance_c: float) -> dict[str, Any]:
        return {
            "before": self.before,
            "after": len(self.cloud),
            "tolerance_c": tolerance_c,
            "rms_c": self.loss.rms_c,
            f"q{STRICT:g}_c": self.loss.strict_c,
            **{f"{name}_rms": lost for name, lost in self.loss.companions.items()},
            "rounds": self.rounds,
            "views": len(self.frames),
        }

    def _tell(self, doing: str, views: int) -> None:
        """Says how far the search is, unless it did so lately; ``views`` of its own are done in what it is doing."""
        if time.monotonic() >= self.told_at + TOLD_SECONDS:
            self.told_at = time.monotonic()
            log.info(
                "merging, round %d, %s (view %d of %d): %d Gaussians are left so far, %.4f °C are lost",
                self.rounds, doing, views, len(self.frames), len(self.cloud), self.loss.rms_c,
            )  # fmt: skip

    # Rounds ----------------------------------------------------------------------------------------------------------

    def merge_until(self, tolerance_c: float, level: int) -> None:
        """Merges as long as the loss stays within a tolerance; ``level`` counts the calls."""
        companions = self.options.companion_tolerance * tolerance_c / self.options.tolerance_c
        self._weigh(level)
        while True:
            self.rounds += 1
            pairs, rows = self._candidates()
            fewest = max(1, math.ceil(FEWEST * len(self.cloud)))
            if len(pairs) < fewest:
                return
            trial = self._replaced(pairs, rows)
            blame = self._blame(trial, len(pairs))
            allowed = (tolerance_c / self.span_k) ** 2 - (self.loss.rms_c / self.span_k) ** 2
            order = blame.argsort(stable=True)
            kept = int((blame[order].cumsum(0) <= STEP * allowed).sum())
            for name in (WEIGHT, CHANGE):  # the others are dearer than was thought
                self.cloud.state[name][pairs[order[kept:]].flatten()] *= DEARER
            while kept >= fewest:
                chosen = order[:kept].sort().values
                trial = self._replaced(pairs[chosen], {name: row[chosen] for name, row in rows.items()})
                loss = self._loss(trial.splats)
                if loss.rms_c <= tolerance_c and all(lost <= companions for lost in loss.companions.values()):
                    self.cloud, self.loss = trial, loss
                    break
                kept //= 2
            else:
                return

    def _replaced(self, pairs: Tensor, rows: Mapping[str, Tensor]) -> Cloud:
        """The Gaussians with the merged ones, at the end, in place of pairs [n, 2]."""
        trial = Cloud(copy.deepcopy(self.cloud.splats), state=dict(self.cloud.state))
        keep = torch.ones(len(trial), dtype=torch.bool, device=pairs.device)
        keep[pairs.flatten()] = False
        trial.keep(keep)
        trial.append(rows)
        for name in (WEIGHT, CHANGE):  # they hardly overlap
            trial.state[name][-len(pairs) :] = self.cloud.state[name][pairs].sum(1)
        return trial

    def _blame(self, trial: Cloud, count: int) -> Tensor:
        """Mean squared difference [count] of the images of a trial from those before it, dealt out to its last Gaussians by
        their blending weights."""
        module, blame, total, pixels = self.module, 0.0, 0.0, 0
        for first in range(0, len(self.frames), VIEWS):
            frames = self.frames[first : first + VIEWS]
            with module.showing(self.cloud.splats):
                before = [module.render(frame).features for frame in frames]
            with module.showing(trial.splats), torch.enable_grad():
                for frame, was in zip(frames, before, strict=True):
                    values = module.emissions(trial.splats, frame).requires_grad_()
                    image = module.render(frame, values=values).features
                    squares = (image.detach() - was).square()
                    (weighted,) = torch.autograd.grad((image * squares).sum(), [values])
                    blame = blame + weighted[-count:].double().sum(1)
                    total, pixels = total + squares.double().sum().item(), pixels + squares.numel()
            self._tell("dealing out what changed", first + len(frames))
        return blame * (total / pixels / blame.sum().clamp(min=1e-300))

    # Which pairs -----------------------------------------------------------------------------------------------------

    def _candidates(self) -> tuple[Tensor, dict[str, Tensor]]:
        """Pairs [n, 2] of Gaussians that agree, each in one pair, the cheapest of all; with them what each becomes."""
        splats, module = self.cloud.splats, self.module
        shapes = Shapes.of(splats)
        pairs = neighbour_pairs(splats.means.detach(), self.options.neighbours)
        told = torch.stack([module.emissions(splats, frame) for frame in self.sampled_frames])  # [F, N, C]
        limits = self._limits(told)
        prices = torch.cat([self._prices(part, shapes, told, limits) for part in pairs.split(PAIRS)])
        chosen = pairs[_mutual(pairs, prices, len(splats))[: math.ceil(self.options.share * len(splats))]]
        rows, agrees = self._rows(chosen, merged(shapes[chosen[:, 0]], shapes[chosen[:, 1]]), told, limits)
        return chosen[agrees], {name: row[agrees] for name, row in rows.items()}

    def _prices(self, pairs: Tensor, shapes: Shapes, told: Tensor, limits: Tensor) -> Tensor:
        """What merging each of some pairs [n, 2] would change, [n]; infinite where they do not agree at all times."""
        a, b = pairs.unbind(1)
        first, second, state = shapes[a], shapes[b], self.cloud.state
        one = merged(first, second)
        apart = told[:, a].double() - told[:, b].double()
        # Each is off the mean by the other's share of what is between them, and shows it by its opacity.
        seen = torch.maximum((1 - one.shares) * first.opacities.amax(1), one.shares * second.opacities.amax(1))
        agree = (apart.abs().amax(0) / limits).amax(1) * seen <= 1
        heat = state[WEIGHT][a] * (1 - one.shares).square() + state[WEIGHT][b] * one.shares.square()
        prices = apart.square().mean(0).sum(1) * heat + one.distances * (state[CHANGE][a] + state[CHANGE][b])
        return prices.where(agree, torch.inf)

    def _limits(self, told: Tensor) -> Tensor:
        """How far the features [F, N, C] of a pair may lie apart, [C]."""
        own = self.module.thermal.modality_channels[0]
        agree = self.options.agree_c
        other = self.options.companion_tolerance * agree / self.options.tolerance_c
        limits = told.new_full((told.shape[2],), other, dtype=torch.float64)
        limits[:own] = agree / self.span_k
        return limits

    def _rows(self, pairs: Tensor, one: Merged, told: Tensor, limits: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        """Raw tensors of what pairs become, and which of them [n] bool agree with both at all times."""
        splats = self.cloud.splats
        first, second = self.cloud.rows(pairs[:, 0]), self.cloud.rows(pairs[:, 1])
        shape = {name: value.to(splats[name].dtype) for name, value in one.raw().items()}
        mean, heavier, heat = dict(shape), dict(shape), [name for name in splats.names if name not in GEOMETRY]
        for name in heat:
            share = one.shares.reshape(-1, *[1] * (first[name].ndim - 1)).to(first[name].dtype)
            heavier[name] = torch.where(share >= 0.5, first[name], second[name])
            constant = name in self.module.constants
            mean[name] = heavier[name] if constant else share * first[name] + (1 - share) * second[name]
        off = [self._off(rows, pairs, told, limits) for rows in (mean, heavier)]
        better = off[0] <= off[1]
        for name in heat:
            mean[name] = torch.where(better.reshape(-1, *[1] * (mean[name].ndim - 1)), mean[name], heavier[name])
        return mean, torch.minimum(*off) <= 1

    def _off(self, rows: Mapping[str, Tensor], pairs: Tensor, told: Tensor, limits: Tensor) -> Tensor:
        """How far the features of rows are from those of both of their pair, times the opacity of either, at the worst time,
        [n] in limits."""
        if not len(pairs):
            return limits.new_zeros(0)
        splats = Splats(rows)
        worst = limits.new_zeros(len(pairs))
        shown = self.cloud.splats.opacities.double().amax(0)
        for at, frame in zip(told, self.sampled_frames, strict=True):
            here = self.module.emissions(splats, frame).double()
            for place in pairs.unbind(1):
                worst = worst.maximum(((here - at[place]).abs() / limits).amax(1) * shown[place])
        return worst

    def _weigh(self, level: int) -> None:
        """Measures of each Gaussian the sum of its squared blending weights over pixels and views, and that of the squared
        changes of the images by all of its opacity, from random signs, whose mean square it is."""
        module, splats = self.module, self.cloud.splats
        weight, change = (splats.means.new_zeros(len(splats), dtype=torch.float64) for _ in range(2))
        logits = splats["opacity_logits"]
        with module.showing(splats), torch.enable_grad():
            for i, frame in enumerate(self.frames):
                values = module.emissions(splats, frame).requires_grad_()
                image = module.render(frame, values=values).features
                draw = module.generator(level * len(self.frames) + i, "merge")
                signs = (2.0 * torch.randint(0, 2, image.shape, generator=draw) - 1.0).to(image)
                by_value, by_logit = torch.autograd.grad((image * signs).sum(), [values, logits])
                weight += by_value.double().square().sum(1)
                # by o in units of o, of o = sigmoid(logit)
                change += (by_logit.double() / (1 - logits.detach().double().sigmoid())).square().sum(1)
                self._tell("weighing the Gaussians", i + 1)
        self.cloud.state |= {WEIGHT: _floored(weight), CHANGE: _floored(change)}

    # What is lost ----------------------------------------------------------------------------------------------------

    def _images(self, frame: Frame) -> dict[str, Tensor]:
        """The clean image and those of companions."""
        images = self.module.predict_all(frame)
        return {name: images[name].cpu() for name in ("clean", *self.module.thermal.companions)}

    def _loss(self, splats: Splats) -> _Loss:
        """What other splats lose, of one view after another: of single pixels only the largest differences are kept."""
        names = ("clean", *self.module.thermal.companions)
        pixels = {name: sum(wanted[name].numel() for wanted in self.wanted) for name in names}
        squares, largest = dict.fromkeys(names, 0.0), torch.zeros(0)
        most = pixels["clean"] - math.ceil(STRICT * pixels["clean"]) + 1
        with self.module.showing(splats):
            for i, (frame, wanted) in enumerate(zip(self.frames, self.wanted, strict=True)):
                for name, image in self._images(frame).items():
                    off = (image - wanted[name]).abs().flatten()
                    squares[name] += off.double().square().sum().item()
                    if name == "clean":
                        largest = torch.cat([largest.to(off), off])
                        largest = largest.topk(min(most, len(largest)), sorted=False).values
                self._tell("comparing the images", i + 1)
        rms = {name: math.sqrt(squares[name] / pixels[name]) for name in names}
        return _Loss(self.span_k * rms.pop("clean"), self.span_k * largest.min().item(), rms)


def _floored(values: Tensor) -> Tensor:
    """What no view shows is not free: another view may."""
    seen = values[values > 0]
    return values.clamp(min=UNSEEN * seen.median()) if len(seen) else torch.ones_like(values)


def _mutual(pairs: Tensor, prices: Tensor, count: int) -> Tensor:
    """Numbers of the pairs [n, 2] that are the cheapest of both of their Gaussians, cheapest first; ties by number."""
    order = prices.argsort(stable=True)
    order = order[prices[order].isfinite()]
    ranks = torch.arange(len(order), device=order.device)
    best = torch.full((count,), len(order), device=order.device)
    ranked = pairs[order]
    for side in (0, 1):
        best.scatter_reduce_(0, ranked[:, side], ranks, "amin")
    return order[(best[ranked[:, 0]] == ranks) & (best[ranked[:, 1]] == ranks)]
