"""Flat images: structural similarity and the lengths of gradients (losses)."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from benchmarks.stability.case import Case, log_uniform, uniform
from heatsplat.losses.compose import LossInputs
from heatsplat.losses.photometric import C1, C2, SIGMA, WINDOW, Photometric, ssim_map
from heatsplat.losses.sobel import TINY, sobel_magnitude
from heatsplat.training.rng import generator_for

COUNT = 6  # pairs of images
SIDE = 11


@lru_cache
def _pairs() -> tuple[Tensor, Tensor]:
    """Bright, almost flat images [COUNT, SIDE, SIDE, 1] twice, float64 with values of float32."""
    level = uniform("level", 0.5, 1.0, COUNT)[:, None, None, None]
    contrast = log_uniform("contrast", 1e-5, 1e-2, COUNT)[:, None, None, None]
    generator = generator_for(0, 0, "flat images")
    noise = torch.rand(2, COUNT, SIDE, SIDE, 1, generator=generator, dtype=torch.float64)
    return tuple((level - contrast * noise).float().double())


def _numbers() -> dict[str, Tensor]:
    return {"index": torch.arange(COUNT, dtype=torch.float64), "change": torch.zeros(COUNT, dtype=torch.float64)}


@lru_cache
def _pattern() -> Tensor:
    pattern = torch.rand(SIDE, SIDE, 1, generator=generator_for(0, 0, "pattern"), dtype=torch.float64) - 0.5
    return pattern.float().double()


def _changed(index: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
    """Predictions, with ``change`` (of nothing) times a pattern, and targets, [n, SIDE, SIDE, 1] each."""
    predictions, targets = (images[index.long()].to(change) for images in _pairs())
    return predictions + change[:, None, None, None] * _pattern().to(change), targets


def _ssim_ours(index: Tensor, change: Tensor) -> Tensor:
    return torch.stack([ssim_map(*pair).mean() for pair in zip(*_changed(index, change), strict=True)])


def _ssim_fused(index: Tensor, change: Tensor) -> Tensor:
    loss, found = Photometric(1.0), []
    for prediction, target in zip(*_changed(index, change), strict=True):
        inputs = LossInputs(prediction, target, None, None, None)
        found.append(1 - loss(inputs)["dssim"])
    return torch.stack(found)


def _taps_exact():
    import mpmath

    taps = [mpmath.exp(-mpmath.mpf((i - WINDOW // 2) ** 2) / (2 * mpmath.mpf(SIGMA) ** 2)) for i in range(WINDOW)]
    return [tap / sum(taps) for tap in taps]


def _ssim_printed(index: Tensor, change: Tensor) -> Tensor:
    """Wang et al. 2004 with variances as E[x²] - E[x]², zeros outside the image."""
    taps = torch.tensor([float(tap) for tap in _taps_exact()], dtype=torch.float64).to(change)
    kernel = (taps[:, None] * taps)[None, None]

    def mean(images: Tensor) -> Tensor:
        return torch.nn.functional.conv2d(images, kernel, padding=WINDOW // 2)

    x, y = (images.permute(0, 3, 1, 2) for images in _changed(index, change))
    mx, my = mean(x), mean(y)
    vx, vy, vxy = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    return ((2 * mx * my + C1) * (2 * vxy + C2) / ((mx**2 + my**2 + C1) * (vx + vy + C2))).mean((1, 2, 3))


def _ssim_exact(index, change):
    import mpmath

    c1, c2 = mpmath.mpf(C1), mpmath.mpf(C2)
    prediction, target = (images[int(index), :, :, 0].tolist() for images in _pairs())
    rows = zip(prediction, _pattern()[:, :, 0].tolist(), strict=True)
    x = [[value + change * part for value, part in zip(*row, strict=True)] for row in rows]
    y = [[mpmath.mpf(value) for value in row] for row in target]
    taps = _taps_exact()

    def mean(image):
        for _ in range(2):  # rows, then columns
            image = [
                [
                    mpmath.fdot(
                        (taps[j], row[i + j - WINDOW // 2]) for j in range(WINDOW) if 0 <= i + j - WINDOW // 2 < SIDE
                    )
                    for row in image
                ]
                for i in range(SIDE)
            ]
        return [value for row in image for value in row]

    def product(a, b):
        return [[p * q for p, q in zip(*rows, strict=True)] for rows in zip(a, b, strict=True)]

    total = 0
    for mx, my, xx, yy, xy in zip(*map(mean, (x, y, product(x, x), product(y, y), product(x, y))), strict=True):
        contrast = (2 * (xy - mx * my) + c2) / (xx - mx * mx + yy - my * my + c2)
        total += (2 * mx * my + c1) / (mx * mx + my * my + c1) * contrast
    return (total / SIDE**2,)


def _slopes(contrast: Tensor) -> Tensor:
    """Images [3, 3] that rise by ``contrast`` per pixel to the right, [n, 3, 3]."""
    return (contrast[:, None] * torch.arange(3).to(contrast))[:, None, :].expand(-1, 3, -1)


def _magnitude_printed(contrast: Tensor) -> Tensor:
    image = _slopes(contrast)
    x = (image[:, :, 2] - image[:, :, 0]) @ torch.tensor([1.0, 2.0, 1.0]).to(contrast)
    y = (image[:, 2] - image[:, 0]) @ torch.tensor([1.0, 2.0, 1.0]).to(contrast)
    return (x * x + y * y).sqrt()


def _magnitude_exact(contrast):
    import mpmath

    return (mpmath.sqrt((8 * contrast) ** 2 + mpmath.mpf(TINY)),)


CASES = (
    Case(
        "Structural similarity of bright, almost flat images",
        "level 0.5 .. 1, contrast 1e-5 .. 0.01; slope by a pattern on top",
        "variances as E[x²] - E[x]² (Wang et al. 2004)",
        "1; slope: itself",
        _numbers, _ssim_printed, _ssim_ours, _ssim_exact,
        by="change", scale=lambda exact: 1, promise=1500.0,
    ),
    Case(
        "The same in the fused kernel of the loss",
        "as above",
        "variances as E[x²] - E[x]² (Wang et al. 2004)",
        "1; slope: itself",
        _numbers, _ssim_printed, _ssim_fused, _ssim_exact,
        by="change", scale=lambda exact: 1, promise=1500.0, types=("float32",),
    ),
    Case(
        "The length of a gradient where an image is flat",
        "rise per pixel 0 and 1e-12 .. 0.1; slope by the rise",
        "√(x² + y²)",
        "1; slope: 8",
        lambda: {"contrast": torch.cat([torch.zeros(1).double(), log_uniform("rise", 1e-12, 0.1, 40)])},
        _magnitude_printed,
        lambda contrast: torch.stack([sobel_magnitude(image[..., None])[1, 1, 0] for image in _slopes(contrast)]),
        _magnitude_exact,
        by="contrast", scale=lambda exact: 1, slope_scale=lambda exact, slopes: 8, promise=8.0,
    ),
)  # fmt: skip
