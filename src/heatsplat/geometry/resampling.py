"""Images on another grid of pixels: linear, separable, differentiable, and exact about half pixels."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

import torch
from torch import Tensor

CUBIC_A = -0.5  # slope of Keys' cubic at 1; the value that antialiased bicubic filters use


def _overlap(distances: Tensor, step: float) -> Tensor:
    """How much of new pixels, ``step`` wide, lies in old ones of width 1 whose centres are so far away."""
    return ((1.0 + step) / 2 - distances.abs()).clamp(min=0.0, max=min(step, 1.0))


def _triangle(x: Tensor) -> Tensor:
    return (1.0 - x.abs()).clamp(min=0.0)


def _cubic(x: Tensor) -> Tensor:
    x, a = x.abs(), CUBIC_A
    inner = ((a + 2.0) * x - (a + 3.0)) * x * x + 1.0
    outer = a * (((x - 5.0) * x + 8.0) * x - 4.0)
    return torch.where(x < 1.0, inner, torch.where(x < 2.0, outer, 0.0))


def _lanczos3(x: Tensor) -> Tensor:
    return torch.where(x.abs() < 3.0, torch.sinc(x) * torch.sinc(x / 3.0), 0.0)


def _stretched(kernel: Callable[[Tensor], Tensor]) -> Callable[[Tensor, float], Tensor]:
    """A kernel that is as wide as a new pixel where that is larger than an old one."""
    return lambda distances, step: kernel(distances / max(step, 1.0))


CUT_SHARE = 1e-3  # of a new pixel that may lie in pixels which were cut off, and it still counts as measured

# Weights of old pixels of width 1 at these distances from the centre of a new one, and its width.
KERNELS: dict[str, Callable[[Tensor, float], Tensor]] = {
    "area": _overlap,
    "bilinear": _stretched(_triangle),
    "bicubic": _stretched(_cubic),
    "lanczos": _stretched(_lanczos3),
}


def resampled(image: Tensor, height: int, width: int, kernel: str = "bicubic") -> Tensor:
    """The image on ``height`` x ``width`` pixels, [height, width, C].

    **Convention:** old and new image cover the same rectangle and pixel centres lie at +0.5, so intrinsics change by
    ``Camera.resized``. Where the image shrinks the kernel is stretched over what one new pixel covers (antialiasing);
    at the border the weights that are left are scaled to sum to one. Values may overshoot with bicubic and Lanczos.

    The result is two small matrix products. That is what ``interpolate(antialias=True)`` of torch computes to float32
    rounding, with a backward pass several times as fast on a CPU.

    Args:
        image: [H, W, C], floating point. Differentiable.
        height, width: size of the result in pixels.
        kernel: "area" (the average of what a new pixel covers, parts of old ones included), "bilinear", "bicubic" (Keys,
            a = -1/2) or "lanczos" (three lobes).

    Raises:
        ValueError: the kernel is unknown or there would be no pixel.
    """
    if image.shape[:2] == (height, width):
        return image
    rows = weights(image.shape[0], height, kernel).to(image)
    columns = weights(image.shape[1], width, kernel).to(image)
    planes = image.permute(2, 0, 1)
    # What shrinks goes first.
    planes = (rows @ planes) @ columns.T if height < image.shape[0] else rows @ (planes @ columns.T)
    return planes.permute(1, 2, 0)


def valid_after(mask: Tensor, height: int, width: int, kernel: str = "bicubic") -> Tensor:
    """Which pixels of a resampled image rest on valid pixels alone, [height, width] bool.

    Args:
        mask: [H, W] bool, True where a pixel is valid.
        height, width, kernel: as for ``resampled``.
    """
    rows = (weights(mask.shape[0], height, kernel) != 0).float()
    columns = (weights(mask.shape[1], width, kernel) != 0).float()
    touched = rows.to(mask.device) @ (~mask).float() @ columns.T.to(mask.device)
    return touched < 0.5


@lru_cache(maxsize=64)
@torch.inference_mode(False)  # kept for images with a gradient, too
def weights(count: int, new_count: int, kernel: str) -> Tensor:
    """The matrix [new_count, count] float64 that resamples a line of pixels; every row sums to one."""
    if kernel not in KERNELS:
        raise ValueError(f"unknown resampling kernel '{kernel}'; there are {', '.join(KERNELS)}")
    if count < 1 or new_count < 1:
        raise ValueError(f"a line of {count} pixels cannot become one of {new_count}")
    step = count / new_count
    centres = (torch.arange(new_count, dtype=torch.float64) + 0.5) * step
    pixels = torch.arange(count, dtype=torch.float64) + 0.5
    found = KERNELS[kernel](pixels - centres[:, None], step)
    found[found.abs() < 1e-14] = 0.0  # a kernel's zeros, which rounding would count as contributions
    return found / found.sum(1, keepdim=True)


def ends_on(ends: Tensor | None, height: int, width: int) -> Tensor | None:
    """Where an image on ``height`` x ``width`` pixels was cut off, [height, width] int8, None stays: a pixel of which more than
    ``CUT_SHARE`` was, at one end alone.

    Args:
        ends: [H, W] of the image (``View.ends``).
    """
    if ends is None or ends.shape == (height, width):
        return ends
    above, below = (
        resampled((ends == sign)[..., None].float(), height, width, "area")[..., 0] > CUT_SHARE for sign in (1, -1)
    )
    return above.to(torch.int8) - below.to(torch.int8)


def with_what_lies_beyond(target: Tensor, ends: Tensor | None, prediction: Tensor) -> Tensor:
    """The target [H, W, C] of a prediction that may lie beyond what it was cut off at: there the prediction itself, without a
    gradient, so that the two do not differ. The target as it is where ``ends`` is None.

    Args:
        target: [H, W, C].
        ends: [H, W], where it was cut off (``View.ends``).
        prediction: [H', W', C], on the grid of the target or on a finer one.
    """
    if ends is None:
        return target
    there = resampled(prediction.detach(), *target.shape[:2], "area")
    ends = ends[..., None]
    return torch.where(((ends > 0) & (there > target)) | ((ends < 0) & (there < target)), there, target)


def scale_between(fine: tuple[int, int], coarse: tuple[int, int]) -> int | None:
    """The whole number by which a grid (height, width) is finer than another; None where there is none."""
    factor = fine[0] // max(coarse[0], 1)
    return factor if factor >= 1 and (coarse[0] * factor, coarse[1] * factor) == tuple(fine) else None
