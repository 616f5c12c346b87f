"""The photometric loss of 3D Gaussian splatting: (1 - w) L1 + w (1 - SSIM).

The functions ``l1`` and ``ssim_map`` are plain torch and unreduced, so that callers mask and average as they need; they
are also the oracle of the fused kernels that ``Photometric`` uses on the CPU and on CUDA.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.derivatives import once_differentiable
from heatsplat.kernels import gpu
from heatsplat.kernels import ssim as kernel
from heatsplat.losses.compose import LossInputs, LossTerm
from heatsplat.losses.masking import cleared

WINDOW = 11  # taps of the Gaussian window
SIGMA = 1.5  # its standard deviation in pixels
C1, C2 = 0.01**2, 0.03**2  # stabilisers of the luminance and the contrast term for images in [0, 1]


def window(dtype: torch.dtype = torch.float32, device: torch.device | str = "cpu") -> Tensor:
    """The 11 taps of the SSIM window, a Gaussian of 1.5 pixels that sums to one."""
    offsets = torch.arange(WINDOW, dtype=torch.float64, device=device) - WINDOW // 2
    taps = torch.exp(-(offsets**2) / (2 * SIGMA**2))
    return (taps / taps.sum()).to(dtype)


def l1(prediction: Tensor, target: Tensor) -> Tensor:
    """Absolute differences, [H, W, C]."""
    return (prediction - target).abs()


def ssim_map(prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> Tensor:
    """Structural similarity of every pixel, [H, W, C], at most 1 (Wang et al. 2004, Eq. 13).

    **Convention:** 11x11 Gaussian window of 1.5 pixels; images in [0, 1]; pixels outside the image count as 0, and so
    do masked ones: a masked pixel is one that lies outside. (Libraries that reflect or crop the border differ within 5
    pixels of it.)

    Variances are those of images from which the target's mean was taken away, and of a prediction that is far off its own.
    Exact arithmetic would not notice (the missing part of the window is accounted for), float32 does: E[x²] - E[x]² of a
    bright flat image is all rounding. It still is of flat parts that lie far from the mean of their image: at a distance of
    d, a variance is known to 1e-7 d². What rounding leaves below zero counts as zero and has no slope.

    Args:
        prediction, target: [H, W, C], floating point. Differentiable in both.
        mask: [H, W] bool, True where a pixel counts.
    """
    channels = prediction.shape[-1]
    counts = torch.ones_like(target[..., :1], dtype=torch.bool) if mask is None else mask[..., None]
    y_shift = _mean(target.detach(), mask).mean()
    x_shift = _mean(prediction.detach(), mask).mean()
    x_shift = torch.where((x_shift - y_shift).abs() < kernel.NEAR, y_shift, x_shift)
    x, y = (_padded(torch.where(counts, image, 0.0), 0.0) for image in (prediction - x_shift, target - y_shift))
    beyond = _padded(1.0 - counts.expand_as(target).to(target), 1.0)
    taps = window(prediction.dtype, prediction.device).expand(channels, 1, 1, WINDOW)
    blurred = functional.conv2d(torch.cat((x, y, x * x, y * y, x * y, beyond)), taps, groups=channels)
    blurred = functional.conv2d(blurred, taps.transpose(2, 3), groups=channels)
    # outside: share of the window that does not count.
    x_mean, y_mean, xx, yy, xy, outside = blurred.permute(0, 2, 3, 1)
    x_mean, y_mean = x_mean - x_shift * outside, y_mean - y_shift * outside
    x_variance = xx + x_shift**2 * outside - x_mean**2
    y_variance = yy + y_shift**2 * outside - y_mean**2
    covariance = xy + x_shift * y_shift * outside - x_mean * y_mean
    x_mean, y_mean = x_mean + x_shift, y_mean + y_shift
    luminance = (2 * x_mean * y_mean + C1) / (x_mean**2 + y_mean**2 + C1)
    return luminance * (2 * covariance + C2) / ((x_variance + y_variance).clamp(min=0.0) + C2)


class Photometric(LossTerm):
    """The terms "l1" and "dssim", weighted: (1 - w) mean|x - y| and w (1 - mean SSIM).

    Means run over the channels of the pixels that count. Masked pixels neither contribute nor receive a gradient, and
    SSIM windows see them as pixels outside the image, so cropping and masking are the same. Without a pixel that counts
    both terms are 0.

    Args:
        dssim_weight: w in [0, 1]. At 0 SSIM is absent: not computed, not reported.
        dssim_half: halves 1 - SSIM (ETGS, Eq. 36), so that it lies in [0, 1].
        modality: which image: that of a companion, such as "rgb", or None for the model's own.

    Raises:
        ValueError: w is outside [0, 1]; or, when called, the images or the mask do not fit together.
    """

    def __init__(self, dssim_weight: float = 0.2, dssim_half: bool = False, modality: str | None = None) -> None:
        if not 0.0 <= dssim_weight <= 1.0:
            raise ValueError(f"dssim_weight is a share of the loss in [0, 1], got {dssim_weight}")
        self.l1_weight = 1.0 - dssim_weight
        self.dssim_weight = 0.5 * dssim_weight if dssim_half else dssim_weight
        self.modality = modality

    def __call__(self, inputs: LossInputs) -> dict[str, Tensor]:
        (prediction, target), mask = inputs.pair(self.modality), inputs.mask
        if prediction.shape != target.shape or prediction.ndim != 3:
            raise ValueError(
                f"prediction and target must both be [H, W, C], got {list(prediction.shape)} and {list(target.shape)}"
            )
        if mask is not None and mask.shape != target.shape[:2]:
            raise ValueError(f"mask must be {list(target.shape[:2])} like the images, got {list(mask.shape)}")
        fused = _kernels_for(prediction, target)
        if fused is not None and self.dssim_weight > 0.0:
            difference, dissimilarity = fused.apply(prediction, target, mask, self.l1_weight, self.dssim_weight)
            return {"l1": difference, "dssim": dissimilarity}
        prediction, target = cleared(prediction, mask), cleared(target, mask)
        terms = {"l1": self.l1_weight * _mean(l1(prediction, target), mask).mean()}
        if self.dssim_weight > 0.0:
            terms["dssim"] = self.dssim_weight * _mean(1.0 - ssim_map(prediction, target, mask), mask).mean()
        return terms


def _mean(image: Tensor, mask: Tensor | None) -> Tensor:
    """Mean over the pixels that count, [C]; 0 where none does."""
    if mask is None:
        return image.mean((0, 1))
    return cleared(image, mask).sum((0, 1)) / mask.sum().clamp(min=1)


def _padded(image: Tensor, value: float) -> Tensor:
    """An image [H, W, C] with a border of half a window, [1, C, H + 10, W + 10]."""
    return functional.pad(image.permute(2, 0, 1)[None], (WINDOW // 2,) * 4, value=value)


def _kernels_for(prediction: Tensor, target: Tensor) -> type[torch.autograd.Function] | None:
    """The fused form of both terms for these images, or None."""
    if prediction.dtype != torch.float32 or target.dtype != torch.float32:
        return None
    if prediction.device.type == "cpu":
        return _Fused
    return _FusedOnCuda if prediction.is_cuda and gpu.available() else None


_TAPS = window().numpy()


class _Fused(torch.autograd.Function):
    """Mean |x - y| and 1 - mean SSIM, each times a weight, by the kernel; the gradient goes to the prediction only."""

    @staticmethod
    def forward(ctx, prediction, target, mask, *weights):
        prediction, target = prediction.detach().contiguous(), target.detach().contiguous()
        height, width, channels = prediction.shape
        valid, outside = _everywhere(height, width, channels) if mask is None else _coverage(mask, channels)
        shape = height, width * channels, channels, _TAPS
        planes = torch.empty(5, *kernel.plane_shape(height, width, channels))
        images = [image.view(-1).numpy() for image in (prediction, target)]
        scratch = [plane.view(-1).numpy() for plane in (planes[0], planes[1], planes[2:])]
        sums = kernel.forward(*images, valid.numpy(), outside.numpy(), *shape, *scratch)
        ctx.save_for_backward(prediction, target, valid, planes)
        count = max(prediction.numel() if mask is None else int(mask.sum()) * channels, 1)
        ctx.shape, ctx.weights = shape, [weight / count for weight in weights]
        return tuple(prediction.new_tensor(weight * found) for weight, found in zip(ctx.weights, sums, strict=True))

    @staticmethod
    @once_differentiable
    def backward(ctx, v_difference, v_dissimilarity):
        prediction, target, valid, planes = ctx.saved_tensors
        v_prediction = torch.empty_like(prediction)
        images = [image.view(-1).numpy() for image in (prediction, target, valid)]
        scratch = [plane.view(-1).numpy() for plane in (planes[0], planes[1], planes[2:], v_prediction)]
        slopes = v_difference.item(), v_dissimilarity.item()
        weights = [np.float32(weight * slope) for weight, slope in zip(ctx.weights, slopes, strict=True)]
        kernel.backward(*images, *ctx.shape, *scratch[:3], *weights, scratch[3])
        return v_prediction, None, None, None, None


def _coverage(mask: Tensor, channels: int) -> tuple[Tensor, Tensor]:
    """1 where a number of the image counts, and the share of its window that does not, each [H·W·C]."""
    height, width = mask.shape
    valid = mask[..., None].expand(height, width, channels).to(torch.float32).reshape(-1)
    outside = torch.empty_like(valid)
    kernel.coverage(valid.numpy(), height, width * channels, channels, _TAPS, outside.numpy())
    return valid, outside


@lru_cache(maxsize=4)
def _everywhere(height: int, width: int, channels: int) -> tuple[Tensor, Tensor]:
    """``_coverage`` of an image without a mask; the same at every step."""
    return _coverage(torch.ones(height, width, dtype=torch.bool), channels)


class _FusedOnCuda(torch.autograd.Function):
    """As ``_Fused``, in four launches of its own and a few to sum."""

    @staticmethod
    def forward(ctx, prediction, target, mask, *weights):
        from heatsplat.kernels.gpu import ssim as on_cuda  # here, for Triton is not everywhere

        prediction, target = prediction.detach().contiguous(), target.detach().contiguous()
        height, width, channels = prediction.shape
        line, device = width * channels, prediction.device
        means = (image.mean() if mask is None else _mean(image, mask).mean() for image in (prediction, target))
        means = torch.stack(tuple(means))
        if mask is None:
            taps, valid, outside = _everywhere_on(device, height, width, channels)
            weights = _numbers(device, *(weight / max(prediction.numel(), 1) for weight in weights))
        else:
            taps, valid, outside = _coverage_on(mask, channels)
            weights = _numbers(device, *weights) / (mask.sum() * channels).clamp(min=1)
        blocks = -(-line // on_cuda.BLOCK)
        moments, slopes = prediction.new_empty(5, height, line), prediction.new_empty(3, height, line)
        sums = prediction.new_empty(2, height * blocks)
        block, numbers = on_cuda.BLOCK, height * line
        on_cuda.moments_of_rows[height, blocks](
            prediction, target, valid, means, taps, moments, line, numbers, CHANNELS=channels, BLOCK=block
        )
        on_cuda.similarity[height, blocks](
            prediction, target, valid, outside, means, taps, moments, slopes, sums, line, height, numbers, blocks,
            BLOCK=block,
        )  # fmt: skip
        ctx.save_for_backward(prediction, target, valid, means, taps, moments, slopes, weights)
        return (weights * sums.sum(1)).unbind()

    @staticmethod
    @once_differentiable
    def backward(ctx, v_difference, v_dissimilarity):
        from heatsplat.kernels.gpu import ssim as on_cuda

        prediction, target, valid, means, taps, moments, slopes, weights = ctx.saved_tensors
        height, width, channels = prediction.shape
        line = width * channels
        blocks, numbers = -(-line // on_cuda.BLOCK), height * line
        block = on_cuda.BLOCK
        blurred, v_prediction = moments[:3], torch.empty_like(prediction)  # nobody reads the moments any more
        on_cuda.slopes_of_rows[height, blocks](slopes, taps, blurred, line, numbers, CHANNELS=channels, BLOCK=block)
        on_cuda.gradient[height, blocks](
            prediction, target, valid, means, taps, blurred, weights, v_difference, v_dissimilarity, v_prediction, line,
            height, numbers, BLOCK=block,
        )  # fmt: skip
        return v_prediction, None, None, None, None


def _coverage_on(mask: Tensor, channels: int) -> tuple[Tensor, Tensor, Tensor]:
    """The taps of the window, and ``_coverage`` on the device of the mask."""
    taps = window(torch.float64, mask.device)  # in which no library rounds factors to ten bits, as it may in float32
    row = taps.expand(1, 1, 1, WINDOW)
    beyond = _padded((~mask[..., None]).double(), 1.0)
    outside = functional.conv2d(functional.conv2d(beyond, row), row.transpose(2, 3))[0, 0].float()
    return taps.float(), *(
        plane.repeat_interleave(channels).contiguous() for plane in (mask.float().view(-1), outside.view(-1))
    )


@lru_cache(maxsize=4)
def _everywhere_on(device: torch.device, height: int, width: int, channels: int) -> tuple[Tensor, Tensor, Tensor]:
    return _coverage_on(torch.ones(height, width, dtype=torch.bool, device=device), channels)


@lru_cache(maxsize=16)
def _numbers(device: torch.device, *numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float32, device=device)
