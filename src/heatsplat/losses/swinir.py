"""SwinIR (Liang et al. 2021) for super-resolution; its tensors are named as those of the released weights are."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from heatsplat.contracts import SceneError

MEAN = (0.4488, 0.4371, 0.4040)  # of the RGB images that the released networks were trained on


class SwinIR(nn.Module):
    """The network: shallow features, groups of Swin transformer blocks with a residual each, sub-pixel convolution.

    Args:
        scale: factor of super-resolution.
        dim: channels of the features.
        depths: transformer blocks of each group (pairs: plain windows, shifted windows).
        heads: attention heads.
        window: side of the attention windows in pixels.
        mlp_ratio: hidden units of a block's perceptron as a multiple of ``dim``.
        direct: one convolution before the pixel shuffle (the small model, "pixelshuffledirect"); False is the medium
            model's reconstruction ("pixelshuffle").
        channels: of the image, 3 or 1.
    """

    def __init__(
        self,
        scale: int = 4,
        dim: int = 60,
        depths: tuple[int, ...] = (6, 6, 6, 6),
        heads: int = 6,
        window: int = 8,
        mlp_ratio: float = 2.0,
        direct: bool = True,
        channels: int = 3,
    ) -> None:
        super().__init__()
        self.scale, self.window = scale, window
        self.conv_first = _conv(channels, dim)
        self.patch_embed = nn.ModuleDict({"norm": nn.LayerNorm(dim)})
        self.layers = nn.ModuleList(_Group(dim, depth, heads, window, mlp_ratio) for depth in depths)
        self.norm = nn.LayerNorm(dim)
        self.conv_after_body = _conv(dim, dim)
        if direct:
            self.upsample = nn.Sequential(_conv(dim, scale**2 * channels), nn.PixelShuffle(scale))
            self.conv_before_upsample = self.conv_last = None
        else:
            self.conv_before_upsample = nn.Sequential(_conv(dim, 64), nn.LeakyReLU())
            factors = [3] if scale == 3 else [2] * round(math.log2(scale))
            steps = [layer for factor in factors for layer in (_conv(64, 64 * factor**2), nn.PixelShuffle(factor))]
            self.upsample = nn.Sequential(*steps)
            self.conv_last = _conv(64, channels)
        mean = MEAN if channels == 3 else (0.0,) * channels
        self.register_buffer("mean", torch.tensor(mean)[:, None, None], persistent=False)

    def forward(self, image: Tensor) -> Tensor:
        """The image [B, C, scale H, scale W] of [B, C, H, W], for any H and W."""
        height, width = image.shape[2:]
        below, right = (-height) % self.window, (-width) % self.window
        padded = _reflected(image, right, below) - self.mean
        shallow = self.conv_first(padded)
        deep = self.patch_embed["norm"](shallow.permute(0, 2, 3, 1))
        for layer in self.layers:
            deep = layer(deep)
        features = self.conv_after_body(self.norm(deep).permute(0, 3, 1, 2)) + shallow
        if self.conv_last is None:
            fine = self.upsample(features)
        else:
            fine = self.conv_last(self.upsample(self.conv_before_upsample(features)))
        return (fine + self.mean)[..., : height * self.scale, : width * self.scale]


class _Group(nn.Module):
    """Transformer blocks and a convolution, with a residual around them; [B, H, W, C] to the same."""

    def __init__(self, dim: int, depth: int, heads: int, window: int, mlp_ratio: float) -> None:
        super().__init__()
        blocks = (_Block(dim, heads, window, 0 if i % 2 == 0 else window // 2, mlp_ratio) for i in range(depth))
        self.residual_group = nn.ModuleDict({"blocks": nn.ModuleList(blocks)})
        self.conv = _conv(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        deep = x
        for block in self.residual_group["blocks"]:
            deep = block(deep)
        return x + self.conv(deep.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)


class _Block(nn.Module):
    """Attention within windows, shifted by ``shift`` pixels, and a perceptron."""

    def __init__(self, dim: int, heads: int, window: int, shift: int, mlp_ratio: float) -> None:
        super().__init__()
        self.window, self.shift = window, shift
        self.norm1, self.norm2 = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.attn = _Attention(dim, heads, window)
        hidden = int(dim * mlp_ratio)
        self.mlp = nn.ModuleDict({"fc1": nn.Linear(dim, hidden), "fc2": nn.Linear(hidden, dim)})

    def forward(self, x: Tensor) -> Tensor:
        _, height, width, dim = x.shape
        shifted = self.norm1(x)
        mask = None
        if self.shift:
            shifted = shifted.roll((-self.shift, -self.shift), (1, 2))
            mask = _separated(height, width, self.window, self.shift).to(x)
        windows = _windows(shifted, self.window).reshape(-1, self.window**2, dim)
        attended = self.attn(windows, mask).reshape(-1, self.window, self.window, dim)
        attended = _from_windows(attended, height, width)
        if self.shift:
            attended = attended.roll((self.shift, self.shift), (1, 2))
        x = x + attended
        return x + self.mlp["fc2"](functional.gelu(self.mlp["fc1"](self.norm2(x))))


class _Attention(nn.Module):
    """Multi-head attention among the pixels of a window, with a bias by their offset from each other."""

    def __init__(self, dim: int, heads: int, window: int) -> None:
        super().__init__()
        self.heads = heads
        self.relative_position_bias_table = nn.Parameter(torch.zeros((2 * window - 1) ** 2, heads))
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)
        y, x = (axis.flatten() for axis in torch.meshgrid(torch.arange(window), torch.arange(window), indexing="ij"))
        offsets = (y[:, None] - y + window - 1) * (2 * window - 1) + (x[:, None] - x + window - 1)
        self.register_buffer("offsets", offsets, persistent=False)

    def forward(self, x: Tensor, mask: Tensor | None) -> Tensor:
        count, pixels, dim = x.shape
        query, key, value = self.qkv(x).reshape(count, pixels, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        bias = self.relative_position_bias_table[self.offsets].permute(2, 0, 1)[None]
        if mask is not None:  # one mask per window of an image, the same for all images
            bias = (bias + mask[:, None]).repeat(count // len(mask), 1, 1, 1)
        attended = functional.scaled_dot_product_attention(query, key, value, attn_mask=bias)
        return self.proj(attended.transpose(1, 2).reshape(count, pixels, dim))


def _conv(inputs: int, outputs: int) -> nn.Conv2d:
    return nn.Conv2d(inputs, outputs, 3, padding=1)


def _reflected(image: Tensor, right: int, below: int) -> Tensor:
    """The image continued to the right and below by its reflection, however small it is."""
    while right > 0 or below > 0:
        step = (min(right, max(image.shape[3] - 1, 0)), min(below, max(image.shape[2] - 1, 0)))
        if step == (0, 0) or (step[0] == 0 < right) or (step[1] == 0 < below):
            return functional.pad(image, (0, right, 0, below), mode="replicate")
        image = functional.pad(image, (0, step[0], 0, step[1]), mode="reflect")
        right, below = right - step[0], below - step[1]
    return image


def _windows(x: Tensor, window: int) -> Tensor:
    """Windows [B n, w, w, C] of an image [B, H, W, C], row by row."""
    batch, height, width, dim = x.shape
    cut = x.reshape(batch, height // window, window, width // window, window, dim)
    return cut.transpose(2, 3).reshape(-1, window, window, dim)


def _from_windows(windows: Tensor, height: int, width: int) -> Tensor:
    """The image [B, H, W, C] of its windows [B n, w, w, C]."""
    window, dim = windows.shape[1], windows.shape[3]
    cut = windows.reshape(-1, height // window, width // window, window, window, dim)
    return cut.transpose(2, 3).reshape(-1, height, width, dim)


def _separated(height: int, width: int, window: int, shift: int) -> Tensor:
    """Masks [n, w², w²]: -100 between pixels that only the shift has put into one window, else 0."""

    def regions(length: int) -> Tensor:
        position = torch.arange(length)
        return (position >= length - window).int() + (position >= length - shift).int()

    labels = regions(height)[:, None] * 3 + regions(width)
    labels = _windows(labels[None, ..., None], window).flatten(1)
    return torch.where(labels[:, :, None] == labels[:, None, :], 0.0, -100.0)


def from_state_dict(stored: Any, path: Path) -> SwinIR:
    """The network of released weights, its sizes read off the tensors.

    Args:
        stored: what the file holds: tensors by name, or a dict with these under "params" or "params_ema".
        path: of the file, for messages.

    Raises:
        SceneError: these are not the weights of a SwinIR for super-resolution.
    """
    weights = stored
    for key in ("params_ema", "params", "state_dict"):
        if isinstance(weights, dict) and isinstance(weights.get(key), dict):
            weights = weights[key]
    wanted = "layers.0.residual_group.blocks.0.attn.relative_position_bias_table"
    if not isinstance(weights, dict) or not {"conv_first.weight", wanted, "upsample.0.weight"} <= weights.keys():
        some = ", ".join(list(weights)[:3]) if isinstance(weights, dict) else type(weights).__name__
        raise SceneError(
            f"{path} holds no SwinIR for super-resolution (found: {some}); other networks must come as TorchScript or "
            "as a .pt2 of torch.export"
        )
    found = [re.match(r"layers\.(\d+)\.residual_group\.blocks\.(\d+)\.", name) for name in weights]
    places = {(int(match[1]), int(match[2])) for match in found if match}
    depths = tuple(sum(group == i for group, _ in places) for i in range(1 + max(group for group, _ in places)))
    dim, channels = weights["conv_first.weight"].shape[:2]
    entries, heads = weights[wanted].shape
    hidden = weights["layers.0.residual_group.blocks.0.mlp.fc1.weight"].shape[0]
    direct = "conv_last.weight" not in weights
    shuffled = [tensor.shape[0] for name, tensor in weights.items() if re.fullmatch(r"upsample\.\d+\.weight", name)]
    scale = math.isqrt(shuffled[0] // channels) if direct else math.prod(math.isqrt(count // 64) for count in shuffled)
    try:
        network = SwinIR(scale, dim, depths, heads, (math.isqrt(entries) + 1) // 2, hidden / dim, direct, channels)
        computed = ("relative_position_index", "attn_mask")  # which the network works out by itself
        network.load_state_dict({name: tensor for name, tensor in weights.items() if not name.endswith(computed)})
    except (RuntimeError, ValueError) as error:
        raise SceneError(f"{path} looks like SwinIR, but its tensors do not fit together: {error}") from error
    return network.eval()
