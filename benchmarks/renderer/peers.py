"""What the kernels are compared with: the same image, and the same loss, by other means."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib import import_module

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import SceneError
from heatsplat.geometry.projection import project_gaussians
from heatsplat.losses.photometric import C1, C2, WINDOW, l1, ssim_map, window
from heatsplat.renderers.base import ALPHA_MAX, ALPHA_MIN, EPS2D, FOV_MARGIN, rasterization

Renderer = Callable[..., Tensor]  # arguments of ``rasterization`` up to the height -> image [H, W, C]

# ---- renderers ----


def backend(name: str) -> Renderer:
    """A backend of ours as a Renderer; gsplat's tensors go to the GPU."""
    return partial(_render, name)


def _render(name, means, quats, scales, opacities, features, viewmats, Ks, width, height) -> Tensor:
    tensors = [means, quats, scales, opacities, features]
    if name == "gsplat":
        tensors = [tensor.cuda() for tensor in tensors]
    modalities = 1 if opacities.ndim == 1 else len(opacities)
    last = features.shape[1] - (modalities - 1)  # the last modality gets what is left
    split = (1,) * (modalities - 1) + (last,)
    return rasterization(
        *tensors, viewmats, Ks, width, height, modality_channels=split, backend=name, depth=False
    ).features  # fmt: skip


def from_path(path: str) -> Renderer:
    """The function that "module:function" names. Raises SceneError where it names none."""
    module, _, name = str(path).partition(":")
    try:
        return getattr(import_module(module), name)
    except (ImportError, AttributeError, ValueError) as error:
        raise SceneError(f"a renderer is given as module:function, got {path} ({error})") from error


def render_torch_tiles(means, quats, scales, opacities, features, viewmats, Ks, width, height, tile=16) -> Tensor:
    """The image [H, W, C] by plain torch, tile by tile, as a careful user would write it."""
    screen = project_gaussians(means, quats, scales, viewmats, Ks, width, height, EPS2D, FOV_MARGIN)
    with torch.no_grad():
        order = screen.depths.argsort(stable=True)
        reach = (2 * torch.log(opacities.clamp(min=ALPHA_MIN) / ALPHA_MIN)).sqrt()[:, None] * screen.variances.sqrt()
        low, high = screen.means - reach, screen.means + reach
    rows = []
    for top in range(0, height, tile):
        row = []
        for left in range(0, width, tile):
            bottom, right = min(top + tile, height), min(left + tile, width)
            inside = (low[:, 0] < right) & (high[:, 0] > left) & (low[:, 1] < bottom) & (high[:, 1] > top)
            ids = order[inside[order] & (screen.depths[order] > 0.01)]
            y, x = torch.meshgrid(torch.arange(top, bottom) + 0.5, torch.arange(left, right) + 0.5, indexing="ij")
            dx = x.reshape(-1, 1) - screen.means[ids, 0]
            dy = y.reshape(-1, 1) - screen.means[ids, 1]
            p, q, r = screen.whitening[ids].T
            power = -0.5 * ((p * (dx - q * dy)) ** 2 + (r * dy) ** 2)
            alpha = (opacities[ids] * power.exp()).clamp(max=ALPHA_MAX)
            alpha = torch.where(alpha < ALPHA_MIN, 0.0, alpha)
            left_over = torch.cumprod(1 - alpha, dim=1)
            weights = alpha * torch.cat([torch.ones_like(left_over[:, :1]), left_over[:, :-1]], dim=1)
            row.append((weights @ features[ids]).reshape(bottom - top, right - left, -1))
        rows.append(torch.cat(row, dim=1))
    return torch.cat(rows, dim=0)


# ---- losses: 0.8 L1 + 0.2 (1 - SSIM) of images [H, W, C] ----


def full_window_loss(prediction: Tensor, target: Tensor) -> Tensor:
    """With five convolutions by the 11x11 window, as the code of 3D Gaussian Splatting has it."""
    channels = prediction.shape[-1]
    x, y = (image.permute(2, 0, 1)[None] for image in (prediction, target))
    taps = window()
    weight = torch.outer(taps, taps).expand(channels, 1, WINDOW, WINDOW).contiguous()

    def blurred(image: Tensor) -> Tensor:
        return functional.conv2d(image, weight, padding=WINDOW // 2, groups=channels)

    x_mean, y_mean = blurred(x), blurred(y)
    x_variance, y_variance = blurred(x * x) - x_mean**2, blurred(y * y) - y_mean**2
    covariance = blurred(x * y) - x_mean * y_mean
    ssim = (2 * x_mean * y_mean + C1) * (2 * covariance + C2)
    ssim = ssim / ((x_mean**2 + y_mean**2 + C1) * (x_variance + y_variance + C2))
    return 0.8 * l1(prediction, target).mean() + 0.2 * (1 - ssim.mean())


def separable_loss(prediction: Tensor, target: Tensor) -> Tensor:
    """With two convolutions by rows of eleven, ours in plain torch."""
    return 0.8 * l1(prediction, target).mean() + 0.2 * (1 - ssim_map(prediction, target).mean())
