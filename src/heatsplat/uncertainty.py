"""How far the temperature of a pixel is likely off, for any trained scene: from what training views saw of it."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import Frame, SceneData, SceneError, View, ViewSet
from heatsplat.geometry.coverage import Sighting, covered, seen_means
from heatsplat.physics.noise import noise_of_views
from heatsplat.shots import at_time, sightings
from heatsplat.thermal.base import Query

log = logging.getLogger("heatsplat")

WITHIN = 0.6827  # share of a normal distribution within one standard deviation
PIXELS = 40_000  # that calibrate: so many tell five numbers
COLUMNS = 16  # of an image at least, from which these come
KNOWN = 1 << 25  # pixels of training images at most, of which the spread is that of the scene's values
ROUNDS = 60  # of the optimiser that finds them
# By how much of itself the noise that images tell (``noise_of_views``) is off where it outweighs detail: by -1.5 to 3 % on four
# synthetic scenes in two sizes, with noise of 0.5 K.
NOISE_ERROR = 0.02
STRIPS = 32  # of pixels, whose means tell how certain the mean of all is, though those of one strip err together
GAP = 2.0  # usual times between two training images, beyond which the record has a gap
LEAST = 1e-12  # image units²: of what is divided by, or whose logarithm is taken
# Times the variance of the camera's noise is that with which a pixel tells a temperature: neighbouring pixels err together.
STRETCHES = tuple(10.0**power for power in range(7))


GEOMETRY = ("means", "log_scales", "quats", "opacity_logits")  # tensors of Gaussians that heat is not told by
DRAWS = 32  # of signs, by which Gaussians that disagree are weighed: deviations are then known to an eighth
MOST_NUMBERS = 64  # of each Gaussian, of which intervals are made: their matrices have its square
BLOCK = 1 << 24  # numbers (128 MB) in the matrices of the Gaussians that are worked on together
UNALIKE = 1e-7  # what spectra tell of sums of products is exact to 1e-15 of that at lag 0: less than this is none


@dataclass(frozen=True)
class Evidence:
    """What views say of each Gaussian, [N] float64 each.

    Args:
        weight: Σ_p w_ip α_p over their pixels, with blending weights w and opacity α = Σ_i w_i: the row sums of the normal
            matrix WᵀW of temperatures, which bound that matrix from above and are exact for what neighbours have in common
            (separable surrogates; Erdogan and Fessler, Phys. Med. Biol. 44, 1999).
        misfit: mean of the squared residual over these pixels, in image units².
    """

    weight: Tensor
    misfit: Tensor


def _query(frame: Frame) -> Query:
    """What a frame asks of a thermal model."""
    return Query(None, frame.camera, frame.time_s, frame.frame_id)


def _pixels(view: View, modality: str) -> Tensor:
    """Values of the pixels of a view that its mask leaves, of any shape in a row."""
    image = view.image(modality)
    return (image if view.mask is None else image[view.mask]).flatten()


def _pixels_of(views: ViewSet) -> int:
    """How many pixels the images of some views have."""
    return sum(frame.camera.width * frame.camera.height for frame in views.frames)


def _stride(every: int, width: int) -> int:
    """Every how many-th pixel of an image, row by row, is taken: ``every`` or a little more, where that would always meet the
    same few columns."""
    every = max(1, every)
    while width // math.gcd(every, width) < min(COLUMNS, width):
        every += 1
    return every


def _that_tell(views: ViewSet) -> ViewSet:
    """The views of which pixels count."""
    return views.subset([i for i, view in enumerate(views) if view.counts])


def _gathered(module: Any, view: View, maps: Tensor) -> Tensor:
    """Σ_p w_ip α_p m_p [N, M] of maps m [H, W, M] over the pixels of a view that count; maps of 1 are weights."""
    with torch.enable_grad():  # what pixels gather from Gaussians, the gradient gives back to them
        values = torch.zeros(len(module.splats), maps.shape[-1], device=module.device, requires_grad=True)
        seen = module.composited(view.frame, values)
        maps = seen.alpha[0].detach()[..., None] * maps
        counted = maps.isfinite() if view.known is None else maps.isfinite() & view.known[..., None]
        (found,) = torch.autograd.grad((seen.features * maps.where(counted, 0.0)).sum(), values)
    return found.cpu().double().clamp(min=0.0)


def _residual(module: Any, view: View) -> tuple[Tensor, Tensor]:
    """What a view says of the Gaussians, [N] each: ``Evidence.weight``, and the mean of what it has above the rendered image."""
    with torch.no_grad():
        above = (view.image(module.modality) - module.predict(view.frame)).mean(-1)
    weight, more, less = _gathered(
        module, view, torch.stack([above * 0.0 + 1.0, above.clamp(min=0.0), (-above).clamp(min=0.0)], dim=-1)
    ).unbind(1)
    return weight, (more - less) / weight.clamp(min=LEAST)


def redundancy(residuals: Tensor, weights: Tensor) -> float:
    """How many views tell as much as one would if their errors were independent, 1 or more: the integrated autocorrelation
    time of residuals, up to the first lag at which they are not alike.

    Sums of products at all lags come from spectra (Wiener and Khinchin), so that it takes as long as there are views.

    Args:
        residuals: [V, N] of each Gaussian in each view, in the order of time.
        weights: [V, N] by which they count.
    """
    views = len(residuals)
    columns, spectra = max(1, BLOCK // (8 * views)), 0.0
    for residual, weight in zip(residuals.split(columns, dim=1), weights.split(columns, dim=1), strict=True):
        roots = weight.double().T.sqrt()
        rows = torch.stack([residual.double().T * roots, roots])
        # With as many zeros behind them, or their end would meet their start.
        spectra = spectra + torch.fft.rfft(rows, n=2 * views).abs().square().sum(1)
    products, weighed = torch.fft.irfft(spectra, n=2 * views)
    found, alone = 1.0, products[0] / weighed[0].clamp(min=LEAST)
    for lag in range(1, views // 2):
        if weighed[lag] <= UNALIKE * weighed[0]:  # no Gaussian is seen in both
            break
        share = float(products[lag] / weighed[lag] / alone.clamp(min=LEAST))
        if share <= UNALIKE:
            break
        found += 2.0 * share
    return found


@torch.no_grad()
def evidence(module: Any, views: Iterable[View]) -> Evidence:
    """What some views say of the Gaussians of a training module: two renderings and one backward pass for each."""
    sums = torch.zeros(len(module.splats), 2, dtype=torch.float64)
    for view in views:
        view = view.to(module.device)
        squares = (module.predict(view.frame) - view.image(module.modality)).square().mean(-1)
        sums += _gathered(module, view, torch.stack([squares * 0.0 + 1.0, squares], dim=-1))
    weight, misfit = sums.unbind(1)
    return Evidence(weight, misfit / weight.clamp(min=LEAST))


@torch.no_grad()
def shown(module: Any, views: Iterable[View]) -> Tensor:
    """How much of some views each Gaussian of a training module shows, [N] float64 in pixels, 0 for those that none sees:
    ``Evidence.weight`` alone, of one rendering and one backward pass for each view."""
    sums = torch.zeros(len(module.splats), dtype=torch.float64)
    for view in views:
        camera = view.frame.camera
        ones = torch.ones(camera.height, camera.width, 1, device=module.device)
        sums += _gathered(module, view.to(module.device), ones)[:, 0]
    return sums


class Uncertainty:
    """Standard deviations of the temperature that a trained scene shows.

    A pixel is uncertain by the sum of some variances:

    * the temperatures of its Gaussians, each known as well as ``Evidence.weight`` tells it for some noise of a pixel, on a
      prior as wide as the scene's values: all that is known of those that no view saw. Gaussians of a pixel are taken to
      err together, which is exact for one, and about √K times too much for K of them;
    * a floor;
    * the misfit that training left at them;
    * position: the gradient of the image times one length in the world;
    * where there are times, the moment: how much changes in half of the time between two training images;
    * in a gap of the record, how much changes up to the nearest training image, of which half is unknown in its middle. Where no
      held-out image lies in a gap, it counts as it is.

    That noise, and how much each of the others counts, is found on images that training did not see (``SceneData.val``:
    what was recorded, not the truth), by maximum likelihood of Laplace's distribution, which forgives outliers. One factor
    then makes the interval hold 68 % of their pixels beyond the noise of the camera. What no training view has seen has the
    whole prior on top.

    **Convention:** °C; image values where they are no temperatures. It is the error of what the surfaces send, without
    the noise of an image that is taken of them.

    Args:
        module: a trained module with its scene.

    Raises:
        SceneError: the scene has no training view, masks leave none of their pixels, or it is under another weather than that
            in which they were recorded.
    """

    def __init__(self, module: Any) -> None:
        scene = module.scene
        if not len(scene.train):
            raise SceneError(f"scene '{scene.name}' has no training views, which tell how certain it is")
        if (other := scene.notes.get("weather_replaced_by")) is not None:
            raise SceneError(
                f"weather={other}: how certain a temperature is follows from the images, which were recorded in another weather. "
                "Leave out weather, or uncertainty"
            )
        self.module = module
        bounds = scene.range_of(module.modality)
        self.unit = 1.0 if bounds is None else bounds.span_k
        self.noise = noise_of_views(scene.train, module.modality)
        # Copies, for a slice would keep its whole image in memory.
        every = max(7, _pixels_of(scene.train) // KNOWN)
        known = torch.cat([_pixels(view, module.modality)[::every].clone() for view in scene.train])
        if not len(known):
            raise SceneError(
                f"masks leave no pixel of the training views of scene '{scene.name}', which tell how certain it is"
            )
        self.prior = float(known.std(correction=0))
        self.evidence = evidence(module, scene.train)
        self.held_out = _that_tell(scene.val)
        if not len(self.held_out):
            self.held_out = _that_tell(scene.train)
            log.warning(
                "scene '%s' holds no images out of which pixels count: intervals are fitted to images that training saw, and are "
                "too narrow",
                scene.name,
            )
        found = self._parts(self.held_out, STRETCHES)
        losses = [_shares(_only(torch.cat(found), i), self.noise)[1] for i in range(len(STRETCHES))]
        best = losses.index(min(losses))
        self.stretch = STRETCHES[best]
        self._held_out_parts = [_only(part, best) for part in found]
        if not self.calibrate():
            log.warning(
                "how far off temperatures of scene '%s' are is hidden in the camera's noise of %.3g %s: intervals are as wide as "
                "what may hide there, %.3g in the median, and errors are likely smaller",
                scene.name, self.noise * self.unit, "image units" if bounds is None else "°C", self.usual,
            )  # fmt: skip

    def calibrate(self, without: Collection[str] = ()) -> bool:
        """Finds how much each variance counts, ``without`` some of the held-out frames (names), to be judged by them.

        Returns whether they tell it; where False, the noise of the camera hides it, and intervals are as wide as it allows.
        """
        frames = self.held_out.frames
        used = [part for frame, part in zip(frames, self._held_out_parts, strict=True) if frame.name not in without]
        self.shares, told = _calibrated(used, self.noise)
        return told

    @torch.no_grad()
    def deviation(self, frame: Frame) -> Tensor:
        """Standard deviation [H, W] of the temperature in each pixel of the image of a frame."""
        variance = self._variances(frame, (self.stretch,)) @ self.shares
        frame = replace(frame, camera=self.module.cameras.of(frame))
        unseen = ~covered(frame.camera, self.module.surface(frame), self._sightings)
        return (variance + unseen * self.prior**2).sqrt().mul(self.unit).float()

    def of_attributes(self, frame: Frame) -> dict[str, Tensor]:
        """Standard deviations [N] of what the thermal model tells of every Gaussian at the time of a frame, by name.

        By the delta method: the numbers that a Gaussian has for its heat are as uncertain as the views that saw it leave them
        (Gauss-Newton, a block for each Gaussian), with their spread over the scene as the prior. Each view tells a temperature
        as well as noise and misfit allow; what views leave is much alike in neighbouring ones, which then count as fewer
        (``redundancy``). What the model takes for granted (``Heat.doubts``) is each wrong by one standard deviation, and the
        numbers are what views then make of it. Not in it is what else all views have in common, such as a wrong emissivity or
        air temperature, and what an observed surface is that the model's is not.

        What neither a Gaussian's numbers nor a doubt change, such as how much of all heat the air lets pass, has none: it is no
        more certain than what the whole scene has in common, of which this knows nothing. NaN where a Gaussian has no value.
        Empty for models that tell nothing, and for those of which a Gaussian has more numbers than such a block can hold, or not
        all the same.
        """
        module, count = self.module, len(self.module.splats)
        told = module.attributes(frame)
        names = list(told)
        if not names:
            return {}
        whole = _Block(module)
        if whole.numbers > MOST_NUMBERS or any(len(tensor) != count for tensor in whole.tensors):
            log.warning(
                "%s has %d numbers for each Gaussian, or not as many for all: there are no intervals of what it learned",
                type(module.thermal).__name__, whole.numbers,
            )  # fmt: skip
            return {}
        spread = whole.spread()
        frames, weights, repeated = self._weighed_views()
        most = count if module.thermal.inseparable else max(1, BLOCK // whole.numbers**2)
        deviations = {name: torch.zeros(count) for name in names}
        for first in range(0, count, most):
            part = slice(first, first + most)
            block = _Block(module, part) if most < count else whole
            block.learn(frames, weights[:, part], repeated, spread)
            for name in names:
                deviations[name][part] = block.deviation(name, frame)
        found = {name: one.where(told[name].isfinite().cpu(), torch.nan) for name, one in deviations.items()}
        return {name: one for name, one in found.items() if bool((one.nan_to_num() != 0).any())}

    def _weighed_views(self) -> tuple[list[Frame], Tensor, float]:
        """Frames of the training views in the order of time, the information [V, N] float32 that each has of a Gaussian's
        temperature (one over its variance), and how many of them tell as much as one (``redundancy``)."""
        views = self.module.scene.train
        order = sorted(range(len(views)), key=lambda k: views.frames[k].time_s or 0.0)
        # In float32, as the gradients that tell them: they are all that is kept of every view.
        weights, residuals = (torch.zeros(len(order), len(self.module.splats)) for _ in range(2))
        for i, view in enumerate(views.subset(order)):
            weight, residuals[i] = _residual(self.module, view.to(self.module.device))
            weights[i] = weight / (self.stretch * self.noise**2 + weight * self.evidence.misfit)
        return [views.frames[k] for k in order], weights, redundancy(residuals, weights)

    @torch.no_grad()
    def attribute_deviations(self, frame: Frame) -> dict[str, Tensor]:
        """Standard deviations [H, W] of what a pixel of a frame shows of each attribute, by name; see ``of_attributes``.

        A pixel shows the mean of its Gaussians, which are taken to err together by what each is uncertain, as one surface;
        that they disagree on top tells what none of them knows of itself, for each was certain with the others as they are.
        It counts as it would in a mean of independent ones: the spread of that mean under random signs of their departures
        (a wild bootstrap over Gaussians). Those that have no value count in neither; NaN where they are most of a pixel.
        """
        module, deviations = self.module, self.of_attributes(frame)
        if not deviations:
            return {}
        told = module.attributes(frame)
        signs = torch.randn(len(module.splats), DRAWS, generator=torch.Generator().manual_seed(0)).sign()
        found = {}
        for name, deviation in deviations.items():
            values = told[name].detach().cpu()[:, None]
            known = values.isfinite() & deviation.isfinite()[:, None]
            columns = torch.cat([values, deviation[:, None], signs, signs * values], dim=1).where(known, 0.0)
            count = columns.shape[1]
            if not known.all():
                columns = torch.cat([columns, known.to(columns)], dim=1)
            seen = module.composited(frame, columns.to(module.device))
            blended = seen_means(seen.features, seen.alpha[0], count).cpu()
            mean, together, drawn = blended[..., :1], blended[..., 1], blended[..., 2:]
            apart = (drawn[..., DRAWS:] - mean * drawn[..., :DRAWS]).square().mean(-1)
            found[name] = (together.square() + apart).sqrt()
        return found

    @property
    def usual(self) -> float:
        """Median standard deviation of the pixels of held-out images."""
        return self._quantile(0.5)

    @property
    def widest(self) -> float:
        """The standard deviation that one pixel in a hundred of held-out images exceeds, for the ends of colours."""
        return self._quantile(0.99)

    def _quantile(self, share: float) -> float:
        return float((torch.cat(self._held_out_parts)[:, 1:] @ self.shares).quantile(share).sqrt()) * self.unit

    def coverage(self) -> float:
        """Share of the pixels of held-out images that lie within one standard deviation, that of the noise included.

        Each image is judged by the calibration on all others, where there are several.
        """
        parts, inside = self._held_out_parts, []
        for i, part in enumerate(parts):
            others = [other for j, other in enumerate(parts) if j != i] or parts
            variance = part[:, 1:] @ _calibrated(others, self.noise)[0] + self.noise**2
            inside.append(part[:, 0] <= variance)
        return float(torch.cat(inside).double().mean())

    # What pixels are made of ----------------------------------------------------------------------------------------------

    def _known(self, stretch: float) -> Tensor:
        """Variance [N] of each Gaussian's temperature, image units²."""
        return 1.0 / (self.evidence.weight / (stretch * self.noise**2) + 1.0 / self.prior**2)

    @torch.no_grad()
    def _variances(self, frame: Frame, stretches: Sequence[float]) -> Tensor:
        """The variances [H, W, S + V] of each pixel in image units², float64, before they are calibrated.

        First what Gaussians are not known, for each of S stretches of the noise.
        """
        module = self.module

        def shown(at: Frame) -> Tensor:
            return module.render(at).features[..., : module.thermal.modality_channels[0]].mean(-1).cpu().double()

        each = torch.stack(
            [*(self._known(stretch).sqrt() for stretch in stretches), self.evidence.misfit.sqrt()], dim=1
        )
        seen = module.composited(frame, each.float().to(module.device), depth=True)
        alpha = seen.alpha[0].cpu().double()
        *known, misfit = seen.features.cpu().double().square().unbind(-1)
        image = shown(frame)
        down, right = torch.gradient(image) if min(image.shape) > 1 else (image * 0, image * 0)
        pixels_per_length = (frame.camera.K[0, 0] * alpha / seen.depth.cpu().double().clamp(min=LEAST)).where(
            alpha > 0, 0
        )
        position = (down.square() + right.square()) * pixels_per_length.square()
        parts = [*known, torch.full_like(misfit, self.noise**2), misfit, position]
        if frame.time_s is not None and "time" in module.scene.metadata:
            start, span = module.scene.record
            apart = span / len(module.scene.train) * (0.5 if frame.time_s < start + 0.5 * span else -0.5)
            parts.append((shown(at_time(module.scene, frame, frame.time_s + apart)) - image).square())
            others_s, share = _across_gap(module.scene, frame.time_s)
            changes = [(shown(at_time(module.scene, frame, time_s)) - image).square() for time_s in others_s]
            parts.append(share * torch.stack(changes).mean(0) if changes else torch.zeros_like(image))
        return torch.stack(parts, dim=-1)

    def _parts(self, views: ViewSet, stretches: Sequence[float]) -> list[Tensor]:
        """Of some pixels of each view the squared residual and the variances, [P, 1 + S + V]."""
        every = _pixels_of(views) // PIXELS
        found = []
        for view in views:
            squares = (
                (self.module.predict(view.frame).cpu() - view.image(self.module.modality)).square().mean(-1).double()
            )
            rows = torch.cat([squares[..., None], self._variances(view.frame, stretches)], dim=-1).flatten(0, 1)
            counted = rows.isfinite().all(1) if view.known is None else rows.isfinite().all(1) & view.known.reshape(-1)
            # A copy, for a slice would keep the rows of the whole image in memory.
            found.append(rows[counted][:: _stride(every, view.frame.camera.width)].clone())
        return found

    @cached_property
    def _sightings(self) -> list[Sighting]:
        return sightings(self.module.scene, self.module.surface)


class _Block:
    """n Gaussians of a module with the K numbers that each has for its heat, and how well views tell these.

    Args:
        module: the module.
        part: which of its Gaussians; None: all.
    """

    def __init__(self, module: Any, part: slice | None = None) -> None:
        self.module, self.splats = module, module.splats
        if part is not None:  # of its own, for the gradient of a part would be as large as the whole
            self.splats = type(self.splats)({name: self.splats[name].detach()[part] for name in self.splats.names})
        names = [name for name in self.splats.names if name not in (*GEOMETRY, *module.constants)]
        self.tensors = [self.splats[name] for name in names]
        self.numbers = sum(tensor[0].numel() for tensor in self.tensors)

    def spread(self) -> Tensor:
        """Variances [K] of the numbers over the Gaussians, float64; 0 of one alone."""
        rows = torch.cat([tensor.detach().reshape(len(tensor), -1) for tensor in self.tensors], dim=1).cpu().double()
        return rows.var(0, correction=min(1, len(rows) - 1))

    def learn(self, frames: Sequence[Frame], weights: Tensor, repeated: float, spread: Tensor) -> None:
        """Takes what views tell of the numbers, before ``deviation`` is asked.

        Args:
            frames: of the V views.
            weights: [V, n] information that each view has of a Gaussian's temperature.
            repeated: how many views tell as much as one.
            spread: [K] variances of the prior.
        """
        count = len(self.splats)
        information = torch.zeros(count, self.numbers, self.numbers, dtype=torch.float64)
        pull = torch.zeros(count, self.numbers, len(self.module.thermal.doubts()), dtype=torch.float64)
        for frame, weight in zip(frames, weights, strict=True):
            slopes, off = self._linearised(partial(self._sent, frame))
            weighed = (weight[:, None] * slopes)[:, :, None]
            information.addcmul_(weighed, slopes[:, None, :])
            pull.addcmul_(weighed, off[:, None, :])
        information /= repeated
        information.diagonal(dim1=1, dim2=2).add_(1 / (4 * spread).clamp(min=LEAST))
        self._factor = torch.linalg.cholesky(information)
        self._moved = -torch.cholesky_solve(pull / repeated, self._factor) if pull.shape[2] else pull

    def deviation(self, name: str, frame: Frame) -> Tensor:
        """Standard deviations [n] float32 of an attribute at the time of a frame."""
        slopes, off = self._linearised(partial(self._attribute, name, frame))
        variance = torch.linalg.solve_triangular(self._factor, slopes[..., None], upper=False).square().sum((1, 2))
        doubted = off + (slopes[:, None] @ self._moved)[:, 0]
        return (variance + doubted.square().sum(1)).sqrt().float()

    def _sent(self, frame: Frame) -> Tensor:
        return self.module.thermal.features(self.splats, _query(frame))[:, 0]

    def _attribute(self, name: str, frame: Frame) -> Tensor:
        return self.module.thermal.attributes(self.splats, _query(frame))[name]

    def _linearised(self, tell: Callable[[], Tensor]) -> tuple[Tensor, Tensor]:
        """Derivatives [n, K] of the values [n] that the model tells by the numbers of each Gaussian, and by how much the values
        are off where each of the model's doubts comes true, [n, D]."""
        with torch.enable_grad():
            values = tell()
            slopes = self._slopes(values)
        values, off = values.detach(), []
        for doubt in self.module.thermal.doubts().values():
            with torch.no_grad(), doubt():
                off.append((tell() - values).cpu().double())
        return slopes, torch.stack(off, dim=1) if off else torch.zeros(len(values), 0, dtype=torch.float64)

    def _slopes(self, values: Tensor) -> Tensor:
        if not values.requires_grad:
            return torch.zeros(len(values), self.numbers, dtype=torch.float64)
        gradients = torch.autograd.grad(values.sum(), self.tensors, allow_unused=True)
        rows = (torch.zeros_like(t) if g is None else g for t, g in zip(self.tensors, gradients, strict=True))
        return torch.cat([row.reshape(len(row), -1) for row in rows], dim=1).cpu().double()


def _across_gap(scene: SceneData, time_s: float) -> tuple[list[float], float]:
    """Moments of the record as far after and before a moment as the nearest training image is, and the share of the mean
    squared change up to them by which the moment is uncertain: that of a random walk that is known on both sides.

    No moments where that image is no farther away than GAP times the usual time between two.
    """
    start, span = scene.record
    before = min((time_s - taken_s for taken_s in scene.train.times_s if taken_s <= time_s), default=math.inf)
    after = min((taken_s - time_s for taken_s in scene.train.times_s if taken_s >= time_s), default=math.inf)
    near, far = sorted((before, after))
    if near <= GAP * span / len(scene.train):
        return [], 1.0
    moments = [min(max(time_s + step, start), start + span) for step in (near, -near)]
    return moments, 1.0 / (1.0 + near / far)


def _only(rows: Tensor, stretch: int) -> Tensor:
    """Rows [P, 1 + S + V] with one of the S stretches, [P, 2 + V]."""
    return torch.cat([rows[:, :1], rows[:, 1 + stretch : 2 + stretch], rows[:, 1 + len(STRETCHES) :]], dim=1)


def _shares(rows: Tensor, noise: float) -> tuple[Tensor, float]:
    """How much of each variance is in squared residuals, [1 + V], by maximum likelihood of Laplace's distribution; its loss.

    Args:
        rows: [P, 2 + V] squared residuals and variances; the first of these, which the prior bounds, counts as it is, as does
            one that none of the pixels has.
        noise: standard deviation of what the residuals have beside them.
    """
    squares, known, others = rows[:, 0], rows[:, 1] + noise**2, rows[:, 2:]
    told = (others > 0).any(0)
    shares, others = rows.new_ones(1 + len(told)), others[:, told]
    start = squares.mean().clamp(min=LEAST) / others.shape[1]
    logs = (start / others.mean(0).clamp(min=LEAST)).log().requires_grad_()
    optimiser = torch.optim.LBFGS([logs], max_iter=ROUNDS, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimiser.zero_grad()
        total = known + others @ logs.exp()
        # As a product, for the root of a quotient has no gradient where a pixel is met exactly.
        value = (0.5 * total.log() + (2 * squares).sqrt() * total.rsqrt()).mean()
        value.backward()
        return value

    with torch.enable_grad():
        optimiser.step(loss)
        reached = float(loss().detach())
    shares[1:][told] = logs.detach().exp()
    return shares, reached


def _calibrated(parts: Sequence[Tensor], noise: float) -> tuple[Tensor, bool]:
    """Shares [1 + V] of the variances with which the interval holds as many pixels as it should, and whether residuals tell them.

    A squared residual lies within q² v + noise² where (r² - noise²) / v is below q². That is a difference of two numbers, neither
    of which is known exactly: a quantile of some pixels, and noise that is an estimate. q² is taken to be at least by how much
    both of them may move it, and where it is negative, which says that the noise was overestimated, by how much it is.
    """
    rows = torch.cat(list(parts))
    shares, _ = _shares(rows, noise)
    squares, variances = rows[:, 0], (rows[:, 1:] @ shares).clamp(min=LEAST)
    excess = (squares - noise**2) / variances
    found = excess.quantile(WITHIN)
    # Rows are in the order of the image, so that pixels that err together are mostly in one strip.
    means = torch.stack([within.double().mean() for within in (excess <= found).chunk(STRIPS)])
    error = float(means.std(correction=min(1, len(means) - 1))) / len(means) ** 0.5
    highest = (squares - (1.0 - NOISE_ERROR) ** 2 * noise**2) / variances
    least = torch.maximum(highest.quantile(min(WITHIN + error, 1.0)) - found, -found)
    told = (rows[:, 1:] > 0).any(0)
    return torch.where(told, shares * torch.maximum(found, least), shares), bool(found >= least)
