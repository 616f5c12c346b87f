"""Resolution over a run: images that start coarse and grow as fast as what is in them calls for."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from heatsplat.contracts import Camera, SceneData, View, evenly_spread
from heatsplat.geometry.resampling import ends_on, resampled
from heatsplat.geometry.spectrum import held, spectrum
from heatsplat.sensors.base import Composite

RATIOS = (8.0, 6.0, 4.0, 3.0, 2.0, 1.5, 1.0)  # few, so that reduced images can be kept
COUNTED = 0.5  # a coarse pixel counts where at least this share of its area does
KEPT_BYTES = 2**29  # of reduced images at most; more are made anew whenever they are seen
SPECTRUM_VIEWS = 20  # of which the spectrum is taken


class Resolution:
    """Full size throughout: nothing is computed and nothing kept. Schedules are subclasses of ``Growing``.

    The ratio says how many pixels of full size fit beside one that is rendered. Full size is what training renders at its
    end: the grid of the training images, or a finer one (``module.supersample``).

    Attributes:
        whole: whether steps see whole images.
    """

    whole = True

    def prepare(self, scene: SceneData, modalities: Sequence[str], composite: Composite, supersample: int) -> None:
        """Takes a scene, the modalities that are learned, the model's own first, and how much finer than images full size is."""

    def ratio(self, progress: float) -> float:
        """The ratio when this share of the run is done; 1 is full size."""
        return 1.0

    def chosen(self, view: View, step: int, seed: int) -> View:
        """What a step sees of a view: all of it, or some of its pixels as a view of a camera of their own."""
        return view

    def reduced(self, view: View, ratio: float) -> View:
        """The view on the grid on which it is compared with what is rendered at this ratio."""
        return view


def rendered(camera: Camera, finer: float) -> Camera:
    """The same camera on a grid that is finer by a factor, to the nearest whole number of pixels."""
    if finer == 1:
        return camera
    return camera.resized(*(max(1, round(finer * side)) for side in (camera.width, camera.height)))


class Growing(Resolution, ABC):
    """Coarse images at first, full size from ``until`` on; the ratio never rises.

    Wanted ratios are taken down to the next of ``RATIOS`` at which a render is a whole multiple of the training images, or
    not finer than they are: images are reduced to the render's grid only where that is coarser than their own.

    Targets are averages over the area of their pixels, of what adds up in a pixel (``Composite``; temperatures, as a rule).
    Masked pixels are left out of them, and coarse pixels of which less than half counts are masked. They are kept as long
    as the ratio stays, ``KEPT_BYTES`` of them at most.

    Args:
        until: share of the run from which on images have full size.
        coarsest: largest ratio.
        short_side: pixels that the shorter side of a rendered image has at least.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(self, until: float = 0.5, coarsest: float = 8.0, short_side: int = 64) -> None:
        if not 0 < until <= 1 or coarsest < 1 or short_side < 1:
            raise ValueError(
                "schedule.until lies in (0, 1], coarsest is at least 1 and short_side at least 1, got "
                f"{until}, {coarsest} and {short_side}"
            )
        self.until, self.coarsest, self.short_side = until, coarsest, short_side
        self._kept: dict[int, View] = {}
        self._kept_bytes, self._kept_ratio = 0, 1.0
        self._steps: tuple[float, ...] = (1.0,)

    def prepare(self, scene: SceneData, modalities: Sequence[str], composite: Composite, supersample: int) -> None:
        self._scene, self._modalities, self._composite, self._finer = scene, modalities, composite, supersample
        self._kept, self._kept_bytes = {}, 0
        shortest = min(min(frame.camera.width, frame.camera.height) for frame in scene.train.frames)
        most = min(self.coarsest, supersample * shortest / self.short_side)
        self._steps = tuple(
            ratio
            for ratio in sorted(RATIOS)
            if ratio == 1 or (ratio <= most and (ratio > supersample or supersample % ratio == 0))
        )

    def ratio(self, progress: float) -> float:
        if progress >= self.until or len(self._steps) == 1:
            return 1.0
        wanted = self.wanted(progress / self.until)
        return self._steps[max(bisect_right(self._steps, wanted * (1 + 1e-9)) - 1, 0)]

    @abstractmethod
    def wanted(self, share: float) -> float:
        """The ratio that is asked for when this share of the growth is done, in [0, 1); it never rises."""

    @torch.no_grad()
    def reduced(self, view: View, ratio: float) -> View:
        if ratio <= self._finer:
            return view
        if ratio != self._kept_ratio:
            self._kept, self._kept_bytes, self._kept_ratio = {}, 0, ratio
        found = self._kept.get(view.frame.frame_id)
        if found is None:
            found = self._made(view, rendered(view.camera, self._finer / ratio))
            size = sum(
                image.nbytes for image in (found.thermal, found.rgb, found.mask, found.ends) if image is not None
            )
            if self._kept_bytes + size <= KEPT_BYTES:
                self._kept[view.frame.frame_id] = found
                self._kept_bytes += size
        return found

    def _made(self, view: View, camera: Camera) -> View:
        images = {name: getattr(view, name) for name in ("thermal", "rgb")}
        images = {name: image for name, image in images.items() if image is not None}
        own = self._modalities[0]
        if own in images:
            images[own] = self._composite.encode(images[own], images[own].shape[-1])
        mask = None
        for name, image in images.items():
            images[name], mask = area_average(image, view.mask, camera.height, camera.width)
        if own in images:
            images[own] = self._composite.decode(images[own], images[own].shape[-1])
        ends = ends_on(view.ends, camera.height, camera.width)
        return replace(view, frame=replace(view.frame, camera=camera), mask=mask, clean=None, ends=ends, **images)


class CoarseToFine(Growing):
    """As coarse as the images' own spectrum allows (the idea of DashGaussian, Chen et al. 2025, section 3.2).

    Begins where pixels hold ``share`` of the amplitudes of the spectrum, or what a ratio of ``coarsest`` to the training
    images leaves if that is more, and shows a share that grows exponentially until it is all of it. Where several
    modalities are learned, the finest decides. Noise of the camera is no detail (``geometry.spectrum``).

    Args:
        share: of the summed amplitudes that the first images hold.
        until, coarsest, short_side: as for ``Growing``.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(self, share: float = 0.25, until: float = 0.5, coarsest: float = 8.0, short_side: int = 64) -> None:
        super().__init__(until, coarsest, short_side)
        if not 0 < share < 1:
            raise ValueError(f"schedule.share lies between 0 and 1, got {share}")
        self.share = share
        self._held: list[np.ndarray] | None = None

    def prepare(self, scene: SceneData, modalities: Sequence[str], composite: Composite, supersample: int) -> None:
        super().prepare(scene, modalities, composite, supersample)
        self._held = None

    def wanted(self, share: float) -> float:
        if self._held is None:  # not before training asks: evaluating a trained scene never does
            self._held = [held(spectrum(_pictures(self._scene, modality))) for modality in self._modalities]
        return self._finer * min(self._of(curve, share) for curve in self._held)

    def _of(self, curve: np.ndarray, share: float) -> float:
        """The ratio of a modality to the grid of its images."""
        most = self._steps[-1] / self._finer
        if curve[-1] == 0 or most <= 1:
            return most
        edges = np.linspace(0.0, 1.0, len(curve))
        first = max(self.share, float(np.interp(1 / self.coarsest, edges, curve)))
        return min(1 / float(np.interp(first ** (1 - share), curve, edges)), most)


class Pyramid(Growing):
    """Fixed ratios, one after the other.

    Args:
        ratios: falling, the last is 1.
        starts: share of the run from which on each holds, the first from 0 on.
        short_side: as for ``Growing``.

    Raises:
        ValueError: they are not as many, not in order, or begin or end elsewhere.
    """

    def __init__(self, ratios: Sequence[float], starts: Sequence[float], short_side: int = 64) -> None:
        falling = all(after < before for before, after in zip(ratios, ratios[1:], strict=False))
        rising = all(after > before for before, after in zip(starts, starts[1:], strict=False))
        if not (falling and rising and len(ratios) == len(starts) > 1 and starts[0] == 0 and ratios[-1] == 1):
            raise ValueError(
                "schedule.ratios falls to 1, and schedule.starts rises from 0 and has as many entries, got "
                f"{list(ratios)} and {list(starts)}"
            )
        super().__init__(starts[-1], ratios[0], short_side)
        self._ratios, self._starts = list(ratios), [start / starts[-1] for start in starts]

    def wanted(self, share: float) -> float:
        return self._ratios[bisect_right(self._starts, share) - 1]


class Cosine(Growing):
    """The side of images grows along half a cosine (EAGLES, Girish et al. 2024).

    Args:
        start: side of the first images as a share of full size.
        until, short_side: as for ``Growing``.

    Raises:
        ValueError: an option is out of its range.
    """

    def __init__(self, start: float = 0.3, until: float = 0.7, short_side: int = 64) -> None:
        if not 0 < start < 1:
            raise ValueError(f"schedule.start lies between 0 and 1, got {start}")
        super().__init__(until, 1 / start, short_side)
        self.start = start

    def wanted(self, share: float) -> float:
        return 1 / (self.start + (1 - self.start) * 0.5 * (1 - math.cos(math.pi * share)))


def area_average(image: Tensor, mask: Tensor | None, height: int, width: int) -> tuple[Tensor, Tensor | None]:
    """Averages over the area of larger pixels, [height, width, C], and which of them count, [height, width] or None.

    Pixels that do not count are left out of the averages. A new one counts where at least half of its area does; where it
    does not, it is NaN.

    Args:
        image: [H, W, C]; whatever it is, NaN too, where the mask is False.
        mask: [H, W] bool, True where a pixel counts; None means that all do.
        height, width: size of the result in pixels.
    """
    if mask is None:
        return resampled(image, height, width, "area"), None
    counted = mask[..., None].to(image)
    sums = resampled(torch.where(mask[..., None], image, 0.0), height, width, "area")
    shares = resampled(counted, height, width, "area")
    counts = shares >= COUNTED - 1e-6
    return torch.where(counts, sums / shares, torch.nan), counts[..., 0]


def _pictures(scene: SceneData, modality: str) -> list[Tensor]:
    """A few training images of a modality, with the mean of those that count where pixels do not."""
    found = []
    for position in evenly_spread(len(scene.train), SPECTRUM_VIEWS):
        view = scene.train[position]
        image = view.image(modality)
        if view.mask is not None:
            inside = view.mask[..., None]
            mean = torch.where(inside, image, 0.0).sum((0, 1)) / view.mask.sum().clamp(min=1)
            image = torch.where(inside, image, mean)
        found.append(image)
    return found
