"""What stands between a surface and a record: haze on the path of the light, and the flaws of a camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from heatsplat.geometry.resampling import resampled
from heatsplat.training.rng import generator_for


@dataclass(frozen=True)
class Haze:
    """Mist at the temperature of the surroundings that thickens and clears as the record runs.

    Args:
        extinction: mean extinction in the thermal band, 1/m.
        swing: largest deviation from it, as a share.
        cycles: how often it thickens during the record.
    """

    extinction: float
    swing: float = 0.0
    cycles: float = 1.0

    def transmission(self, distance_m: Tensor, progress: float) -> Tensor:
        """Share of a surface's excess over the surroundings that arrives from ``distance_m`` away (Beer-Lambert).

        Args:
            progress: part of the record that has passed, 0 to 1.
        """
        thickness = self.extinction * (1.0 + self.swing * math.sin(2.0 * math.pi * self.cycles * progress))
        return torch.exp(-thickness * distance_m)


@dataclass(frozen=True)
class CameraFlaws:
    """Flaws of an uncooled camera: y = s_f [x (1 + G) + B] exp(a2 r² + a4 r⁴) of image values x.

    G and B are smooth fields (a grid of random nodes, enlarged bicubically) plus a column pattern, r is 0 in the middle
    and 1 in the corners, and s_f, the gain, steps where the camera's shutter closes.

    Args:
        gain, bias: standard deviation of the nodes of G and of B (image units).
        columns: standard deviation of the part of B that whole columns share.
        nodes: nodes along each side of the fields.
        falloff: a2, a4.
        step: standard deviation of s_f - 1 from shutter to shutter.
        frames_per_step: frames between two shutters.
    """

    gain: float = 0.03
    bias: float = 0.02
    columns: float = 0.0
    nodes: int = 6
    falloff: tuple[float, float] = (-0.12, -0.08)
    step: float = 0.0
    frames_per_step: int = 12

    def fields(self, height: int, width: int, seed: int) -> tuple[Tensor, Tensor, Tensor]:
        """G, B and the falloff over the image, each [H, W] float64."""
        generator = generator_for(seed, 0, "camera flaws")
        nodes = torch.randn(2, self.nodes, self.nodes, generator=generator, dtype=torch.float64)
        gain, bias = resampled(nodes.permute(1, 2, 0), height, width, "bicubic").unbind(-1)
        stripes = self.columns * torch.randn(width, generator=generator, dtype=torch.float64)
        y = torch.arange(height, dtype=torch.float64) + 0.5 - 0.5 * height
        x = torch.arange(width, dtype=torch.float64) + 0.5 - 0.5 * width
        r2 = (y[:, None] ** 2 + x**2) * (4.0 / (height**2 + width**2))
        falloff = torch.exp(self.falloff[0] * r2 + self.falloff[1] * r2 * r2)
        return self.gain * gain, self.bias * bias + stripes, falloff

    def steps(self, frames: int, seed: int) -> Tensor:
        """s_f of every frame, [F] float64."""
        shutters = -(-frames // self.frames_per_step)
        drawn = torch.randn(shutters, generator=generator_for(seed, 1, "camera flaws"), dtype=torch.float64)
        return 1.0 + self.step * drawn.repeat_interleave(self.frames_per_step)[:frames]

    def record(self, unit: Tensor, seed: int) -> Tensor:
        """What the camera makes of clean images [F, H, W] of values in [0, 1]; values beyond are kept."""
        gain, bias, falloff = self.fields(*unit.shape[1:], seed)
        seen = (unit * (1.0 + gain) + bias) * falloff
        return self.steps(len(unit), seed)[:, None, None] * seen
