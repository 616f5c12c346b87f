"""What stands between a surface and a record: its gloss, haze on the path of the light, and the flaws of a camera."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from heatsplat.datamodules.synthetic_scene.moving import Bolometers
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
class Gloss:
    """Surfaces that are no black bodies: they emit less along themselves, and mirror warm surroundings.

    A surface T that is seen at the angle θ to its normal, and mirrors the direction m, looks as warm as
    A + (1 - ρ) [1 - s (1 - cos θ)] (T - A) + ρ W ((1 + m · m_0) / 2)², A being the ambient temperature.

    Args:
        fade: s, the share of its excess that a surface loses when it is seen edge-on.
        mirrors: ρ, the share of the surroundings that it mirrors.
        warm_k: W, excess of the warmest part of the surroundings.
        towards: m_0, where that part is; any length.
    """

    fade: float = 0.0
    mirrors: float = 0.0
    warm_k: float = 0.0
    towards: tuple[float, float, float] = (0.0, 0.0, 1.0)

    def apparent(self, excess: Tensor, outwards: Tensor, normals: Tensor) -> Tensor:
        """Apparent excess over ambient [n] of surfaces of an excess [n].

        Args:
            outwards: unit vectors [n, 3] from the surface to the camera.
            normals: [n, 3], on the camera's side.
        """
        facing = (outwards * normals).sum(1)
        mirrored = 2.0 * facing[:, None] * normals - outwards
        warmest = torch.nn.functional.normalize(excess.new_tensor(self.towards), dim=0)
        around = self.warm_k * (0.5 * (1.0 + mirrored @ warmest)) ** 2
        return (1.0 - self.mirrors) * (
            1.0 - self.fade * (1.0 - facing.clamp(0.0, 1.0))
        ) * excess + self.mirrors * around


@dataclass(frozen=True)
class CameraFlaws:
    """Flaws of an uncooled camera: y = C(A_f(s_f [P(x) (1 + G) + B] exp(a2 r² + a4 r⁴) + o_f)) of image values x.

    P is a Gaussian blur. G and B are smooth fields (a grid of random nodes, enlarged bicubically) plus a column pattern, r
    is 0 in the middle and 1 in the corners. s_f, the gain, steps where the camera's shutter closes; gain and offset o_f
    walk at random in between and start anew there. A_f(y) = sigmoid(e^{a_f} logit(y) + b_f) of y within [0, 1] is automatic
    gain control, which stretches the contrast of every frame otherwise; a_f and b_f sway evenly over the frames.
    C(y) = y + c y (1 - y) is the tone curve.

    Args:
        gain, bias: standard deviation of the nodes of G and of B (image units).
        columns: standard deviation of the part of B that whole columns share.
        nodes: nodes along each side of the fields.
        falloff: a2, a4.
        step: standard deviation of s_f - 1 from shutter to shutter.
        frames_per_step: frames between two shutters.
        gain_drift: standard deviation of what s_f changes by from frame to frame.
        stretch, shift: largest |a_f| and |b_f|.
        drift: standard deviation of what o_f changes by from frame to frame (image units).
        blur_px: standard deviation of the blur.
        bend: c.
        detector: what it makes of an image that moves, before all of that; None for one that sees a moment.
    """

    gain: float = 0.03
    bias: float = 0.02
    columns: float = 0.0
    nodes: int = 6
    falloff: tuple[float, float] = (-0.12, -0.08)
    step: float = 0.0
    frames_per_step: int = 12
    gain_drift: float = 0.0
    stretch: float = 0.0
    shift: float = 0.0
    drift: float = 0.0
    blur_px: float = 0.0
    bend: float = 0.0
    detector: Bolometers | None = None

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
        steps = 1.0 + self.step * drawn.repeat_interleave(self.frames_per_step)[:frames]
        return steps + self._walk(self.gain_drift, frames, seed, 3) if self.gain_drift else steps

    def offsets(self, frames: int, seed: int) -> Tensor:
        """o_f of every frame, [F] float64; their mean is 0, because a level that all share is nobody's flaw."""
        return self._walk(self.drift, frames, seed, 2)

    def _walk(self, change: float, frames: int, seed: int, draw: int) -> Tensor:
        drawn = torch.randn(frames, generator=generator_for(seed, draw, "camera flaws"), dtype=torch.float64)
        walks = torch.cat([part.cumsum(0) for part in (change * drawn).split(self.frames_per_step)])
        return walks - walks.mean()

    def stretches(self, frames: int, seed: int) -> Tensor:
        """a_f and b_f of every frame, [F, 2] float64: sines of 2.3 and 3.7 cycles over the frames."""
        phases = torch.rand(2, generator=generator_for(seed, 4, "camera flaws"), dtype=torch.float64)
        share = torch.arange(frames, dtype=torch.float64)[:, None] / frames
        cycles = torch.tensor([2.3, 3.7], dtype=torch.float64)
        most = torch.tensor([self.stretch, self.shift], dtype=torch.float64)
        return most * torch.sin(2.0 * math.pi * (cycles * share + phases))

    def blurred(self, images: Tensor) -> Tensor:
        """Images [F, H, W] through the point spread; beyond the border they go on as they end."""
        if not self.blur_px:
            return images
        reach = math.ceil(4.0 * self.blur_px)
        at = torch.arange(-reach, reach + 1, dtype=images.dtype)
        kernel = torch.exp(-0.5 * (at / self.blur_px) ** 2)
        kernel = kernel / kernel.sum()
        wide = torch.nn.functional.pad(images[:, None], (reach,) * 4, mode="replicate")
        rows = torch.nn.functional.conv2d(wide, kernel[None, None, None])
        return torch.nn.functional.conv2d(rows, kernel[None, None, :, None])[:, 0]

    def record(self, unit: Tensor, seed: int) -> Tensor:
        """What the camera makes of clean images [F, H, W] of values in [0, 1]; values beyond are kept."""
        gain, bias, falloff = self.fields(*unit.shape[1:], seed)
        seen = (self.blurred(unit) * (1.0 + gain) + bias) * falloff
        grey = self.steps(len(unit), seed)[:, None, None] * seen
        if self.drift:
            grey = grey + self.offsets(len(unit), seed)[:, None, None]
        if self.stretch or self.shift:
            log_stretch, shift = self.stretches(len(unit), seed)[:, :, None, None].unbind(1)
            grey = torch.sigmoid(log_stretch.exp() * torch.logit(grey.clamp(0.0, 1.0)) + shift)
        return grey + self.bend * grey * (1.0 - grey) if self.bend else grey
