"""How noisy a thermal camera is, judged from its images alone."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

# A Laplacian of Laplacians: blind to anything that varies linearly along rows or columns (Immerkaer, CVIU 64, 1996).
_MASK = torch.tensor([[1.0, -2.0, 1.0], [-2.0, 4.0, -2.0], [1.0, -2.0, 1.0]], dtype=torch.float64)
_MASK_GAIN = 6.0  # root of the sum of its squares
_MAD_TO_SIGMA = 1.4826
# Of the pixels of an image, this share with the least gradient counts: edges pass the mask, flat parts do not.
_FLATTEST = 0.25
_UNIFORM = 1.0 / math.sqrt(12.0)


def noise_of(images: Tensor, step: float = 0.0) -> float:
    """Standard deviation of the noise of a pixel in image units: the median over images [F, H, W].

    **Convention:** never below that of rounding to steps of ``step``; a sensor cannot be judged finer than its files.
    """
    if min(images.shape[1:]) < 5:
        return max(_UNIFORM * step, 1e-6)
    single = [_of_one(image) for image in images]
    return max(float(torch.tensor(single).median()), _UNIFORM * step, 1e-6)


def noise_of_repeats(images: Tensor) -> float:
    """Standard deviation of the noise of a pixel from images [F, H, W] of a still scene by a still camera.

    Successive differences with their median taken away, so that a drift of the whole image does not count.
    """
    steps = images.diff(dim=0).flatten(1).double()
    steps = steps - steps.median(dim=1, keepdim=True).values
    return float(_MAD_TO_SIGMA * steps.abs().median() / math.sqrt(2.0))


def quantum_of(image: Tensor) -> float:
    """The smallest step between two values of an image [H, W]: its quantisation in image units."""
    levels = image.flatten().double().unique()
    gaps = levels.diff()
    gaps = gaps[gaps > 1e-7]  # float32 rounding of one level is no step
    return float(gaps.min()) if len(gaps) else 0.0


def _of_one(image: Tensor) -> float:
    image = image.double()[None, None]
    response = functional.conv2d(image, _MASK[None, None])[0, 0].abs()
    smooth = functional.avg_pool2d(image, 3, stride=1)
    gradient = torch.hypot(
        functional.pad(smooth, (1, 1, 0, 0), mode="replicate").diff(n=1, dim=3)[..., 1:],
        functional.pad(smooth, (0, 0, 1, 1), mode="replicate").diff(n=1, dim=2)[..., 1:, :],
    )[0, 0]
    flat = gradient <= gradient.flatten().kthvalue(max(1, int(_FLATTEST * gradient.numel()))).values
    return _MAD_TO_SIGMA * float(response[flat].median()) / _MASK_GAIN
