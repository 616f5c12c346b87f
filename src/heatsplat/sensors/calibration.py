"""What a microbolometer adds to every image alike: uneven gain and offset of its pixels, and the lens's falloff."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import Frame, SceneData
from heatsplat.geometry.resampling import resampled
from heatsplat.same_bits import everywhere
from heatsplat.sensors.base import SensorPart


class Calibration(SensorPart):
    """[I (1 + G) + B] V of an image I, with fields that belong to the sensor and not to the scene (SupIR-GS, Eq. 4, 6).

    Gain G and bias B are grids of a few nodes, bounded by tanh and interpolated bilinearly over the image, so the same
    field serves every resolution. V = exp(a2 r² + a4 r⁴) with r = 1 in the corners is vignetting.

    A level that gain and emission share, or bias and emission, is nobody's: the mean of both grids is taken away, and
    from the gain also what r² and r⁴ can say, which is left to V. V is 1 in the middle of the image.

    Args:
        grid: nodes along each side.
        gain_max, bias_max: bounds of the nodes of G (a factor) and B (image units) before their means are taken away; 0
            leaves the field out, and both 0 the pattern.
        vignetting_max: bound of |a2| and |a4| each; 0 leaves vignetting out.
        weight: of the penalty mean G² + mean B² + total variation of both + a2² + a4².
        lr, lr_end: learning rate and the factor on it at the end of the run.
    """

    def __init__(
        self,
        grid: int = 16,
        gain_max: float = 0.1,
        bias_max: float = 0.05,
        vignetting_max: float = 0.5,
        weight: float = 5e-4,
        lr: float = 0.03,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__()
        if grid < 2:
            raise ValueError(f"a calibration grid needs 2 nodes along each side or more, got {grid}")
        if grid == 2 and gain_max > 0 and vignetting_max > 0:
            raise ValueError(
                "four nodes lie equally far out and tell no gain from vignetting: give a grid of 3 or more"
            )
        if min(gain_max, bias_max, vignetting_max) < 0:
            raise ValueError(
                f"gain_max, bias_max and vignetting_max must not be negative, got {gain_max}, {bias_max}, {vignetting_max}"
            )
        self.gain_max, self.bias_max, self.vignetting_max = gain_max, bias_max, vignetting_max
        self.weight, self.lr, self.lr_end = weight, lr, lr_end
        self.raw_gain = nn.Parameter(torch.zeros(grid, grid)) if gain_max > 0 else None
        self.raw_bias = nn.Parameter(torch.zeros(grid, grid)) if bias_max > 0 else None
        self.raw_falloff = nn.Parameter(torch.zeros(2)) if vignetting_max > 0 else None
        if self.raw_gain is not None:
            self.register_buffer("shared", torch.full((grid * grid, 1), 1.0 / grid))  # orthonormal columns

    def prepare(self, scene: SceneData, modality: str = "thermal") -> None:
        if self.raw_gain is None:
            return
        camera = scene.train.frames[0].camera
        r2 = radius_squared(len(self.raw_gain), len(self.raw_gain), camera.width / camera.height).flatten()
        powers = (0, 1, 2) if self.raw_falloff is not None else (0,)
        self.shared = torch.linalg.qr(torch.stack([r2**power for power in powers], 1))[0].float()

    def forward(self, image: Tensor, frame: Frame) -> Tensor:
        height, width = image.shape[:2]
        # One by one: side by side the fields would lie between each other in memory, which takes twice as long.
        at = {name: resampled(field[..., None], height, width, "bilinear") for name, field in self.nodes().items()}
        image = image * (1.0 + at["gain"]) if "gain" in at else image
        image = image + at["bias"] if "bias" in at else image
        return image if self.raw_falloff is None else image * self.vignetting(height, width)

    def nodes(self) -> dict[str, Tensor]:
        """ "gain" and "bias" at the nodes of the grid, [grid, grid] each where it is there, without what others share."""
        nodes = {}
        if self.raw_gain is not None:
            gain = self.gain_max * self.raw_gain.tanh()
            level = self.shared @ (self.shared.T @ gain.flatten())
            nodes["gain"] = gain - level.reshape_as(gain)
        if self.raw_bias is not None:
            bias = self.bias_max * self.raw_bias.tanh()
            nodes["bias"] = bias - bias.mean()
        return nodes

    def vignetting(self, height: int, width: int) -> Tensor:
        """V on a grid of pixels, [height, width, 1]; 1 in the middle, all 1 without vignetting."""
        r2 = radius_squared(height, width).float()[..., None]
        if self.raw_falloff is None:
            return torch.ones_like(r2)
        r2 = r2.to(self.raw_falloff)
        a2, a4 = (everywhere(a, r2) for a in self.coefficients())
        return torch.exp((a2 + a4 * r2) * r2)

    def coefficients(self) -> Tensor:
        """a2 and a4 of the vignetting, [2]; empty without."""
        if self.raw_falloff is None:
            return torch.zeros(0)
        return self.vignetting_max * self.raw_falloff.tanh()

    def penalty(self) -> Tensor | None:
        terms = [self.coefficients().square().sum()] if self.raw_falloff is not None else []
        for field in self.nodes().values():
            terms += [field.diff(dim=0).abs().mean() + field.diff(dim=1).abs().mean() + field.square().mean()]
        return sum(terms) if terms else None

    def effects(self) -> dict[str, dict[str, Any]]:
        effects: dict[str, dict[str, Any]] = {}
        if self.raw_gain is not None or self.raw_bias is not None:
            effects["fixed_pattern"] = {"fields": list(self.nodes())}
        if self.raw_falloff is not None:
            a2, a4 = self.coefficients().tolist()
            effects["vignetting"] = {"a2": a2, "a4": a4}
        return effects


@lru_cache(maxsize=16)
def radius_squared(height: int, width: int, aspect: float | None = None) -> Tensor:
    """r² of the pixels of an image, [height, width] float64: 0 in its middle, 1 in its corners.

    Args:
        height, width: of the grid.
        aspect: width over height of the area that the grid covers; by default that of the grid (square pixels).
    """
    aspect = width / height if aspect is None else aspect
    diagonal = math.hypot(aspect, 1.0)
    y = ((torch.arange(height, dtype=torch.float64) + 0.5) / height * 2 - 1) / diagonal
    x = ((torch.arange(width, dtype=torch.float64) + 0.5) / width * 2 - 1) * aspect / diagonal
    return y[:, None] ** 2 + x**2
