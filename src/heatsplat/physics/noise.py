"""How noisy a thermal camera is, judged from its images alone."""

from __future__ import annotations

import math
import statistics

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import ViewSet, evenly_spread

# A Laplacian of Laplacians: blind to anything that varies linearly along rows or columns (Immerkaer, CVIU 64, 1996).
# It is the second difference along rows of that along columns: [[1, -2, 1], [-2, 4, -2], [1, -2, 1]].
_MASK_GAIN = 6.0  # root of the sum of the squares of these
MAD_TO_SIGMA = 1.4826  # standard deviation of normal values over the median of their sizes
# Of the pixels of an image, this share with the least gradient counts: edges pass the mask, flat parts do not.
_FLATTEST = 0.25
MIN_NOISE = 1e-6  # image units; what an image without any shows
_NOISY_VIEWS = 5  # from which the noise of a scene's images is estimated
_UNIFORM = 1.0 / math.sqrt(12.0)


def noise_of_views(views: ViewSet, modality: str) -> float:
    """Standard deviation of the noise of a pixel in the images of a modality, in image units, from a few of the views.

    The median over these views of ``noise_of`` their first channel, each by its own quantisation. Views of which no pixel counts
    tell nothing; of such alone it is ``MIN_NOISE``.
    """
    few = [views[i] for i in evenly_spread(len(views), _NOISY_VIEWS)]
    few = [view for view in few if view.counts]
    if not few:
        return MIN_NOISE
    images = [view.image(modality)[None, ..., 0].double() for view in few]
    known = [view.known if modality == "thermal" else view.mask for view in few]
    masks = [None if one is None else one[None] for one in known]
    single = [
        noise_of(image, quantum_of(image if mask is None else image[mask]), mask)
        for image, mask in zip(images, masks, strict=True)
    ]
    return float(torch.tensor(single, dtype=torch.float64).median())


def noise_of(images: Tensor, step: float = 0.0, masks: Tensor | None = None) -> float:
    """Standard deviation of the noise of a pixel in image units: the median over images [F, H, W].

    Only pixels count whose neighbours all count by ``masks`` [F, H, W] (bool; None: all do).

    **Convention:** never below that of rounding to steps of ``step``; a sensor cannot be judged finer than its files.
    """
    least = max(_UNIFORM * step, MIN_NOISE)
    if min(images.shape[1:]) < 5:
        return least
    single = []
    for f, image in enumerate(images):  # one at a time: what is worked out takes many times the memory of an image
        used = torch.ones_like(image, dtype=torch.bool) if masks is None else _whole(masks[f])
        if used[1:-1, 1:-1].any():
            single.append(_of_one(image, used[1:-1, 1:-1]))
    return max(float(torch.tensor(single).median()), least) if single else least


def noise_of_repeats(images: Tensor, masks: Tensor | None = None) -> float:
    """Standard deviation of the noise of a pixel from images [F, H, W] of a still scene by a still camera.

    Successive differences with their median taken away, so that a drift of the whole image does not count; pixels that do
    not count by ``masks`` [F, H, W] (bool; None: all do) are left out.
    """
    away = torch.full((max(len(images) - 1, 1), *images.shape[1:]), torch.nan)  # float32: all are needed at once
    for f in range(1, len(images)):
        step = images[f].double() - images[f - 1].double()
        if masks is not None:
            step = torch.where(masks[f] & masks[f - 1], step, torch.nan)
        away[f - 1] = (step - step.nanmedian()).abs()
    spread = float(MAD_TO_SIGMA * away.nanmedian() / math.sqrt(2.0))
    return spread if math.isfinite(spread) else 0.0


def robust_spread(values: Tensor) -> float:
    """Standard deviation of values about 0, of any shape, from the median of their sizes; NaN does not count."""
    return MAD_TO_SIGMA * float(values.abs().nanmedian())


def quantum_of(image: Tensor) -> float:
    """The smallest step between two values of an image (of any shape): its quantisation in image units."""
    levels = image.flatten().double().unique()
    gaps = levels.diff()
    gaps = gaps[gaps > 1e-7]  # float32 rounding of one level is no step
    return float(gaps.min()) if len(gaps) else 0.0


def usual_quantum(images: Tensor, masks: Tensor | None = None) -> float:
    """The quantisation of images [F, H, W] in image units, which differs where each has a span of its own: the median of those of
    a few of them, without pixels that are NaN or do not count by ``masks`` [F, H, W]; 0 of none."""
    found = []
    for f in evenly_spread(len(images), _NOISY_VIEWS):
        known = images[f].isfinite()
        found.append(quantum_of(images[f][known if masks is None else known & masks[f]]))
    return statistics.median_high(found) if found else 0.0


def _whole(mask: Tensor) -> Tensor:
    """Where a pixel [H, W] and its eight neighbours all count."""
    return functional.max_pool2d((~mask)[None].float(), 3, stride=1, padding=1)[0] == 0


def _of_one(image: Tensor, used: Tensor) -> float:
    image = image.double()
    response = image.diff(n=2, dim=0).diff(n=2, dim=1).abs()
    smooth = functional.avg_pool2d(image[None, None], 3, stride=1)
    gradient = torch.hypot(
        functional.pad(smooth, (1, 1, 0, 0), mode="replicate").diff(n=1, dim=3)[..., 1:],
        functional.pad(smooth, (0, 0, 1, 1), mode="replicate").diff(n=1, dim=2)[..., 1:, :],
    )[0, 0]
    flat = used & (gradient <= gradient[used].kthvalue(max(1, int(_FLATTEST * int(used.sum())))).values)
    return MAD_TO_SIGMA * float(response[flat].median()) / _MASK_GAIN
