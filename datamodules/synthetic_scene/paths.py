"""Where a hand-held camera is, and when."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from heatsplat.datamodules.synthetic_scene.presets import Preset
from heatsplat.training.rng import generator_for

# The path circles about this point, metres.
_LOOK_AT = (0.0, 0.15, 0.3)
# Frames come faster at the start, when things change fastest: time grows as this power of the frame number.
_HASTE = 1.4
# The camera runs this long after the heat has begun to flow, in seconds; a surface changes infinitely fast at first.
_FIRST_FRAME_S = 20.0


def by_hand(preset: Preset, frames: int, seed: int) -> tuple[np.ndarray, Tensor]:
    """Times [F] and world-to-camera matrices [F, 4, 4] of frames that a hand takes while the heat flows."""
    times = frame_times(frames, preset.duration_s, seed)
    return times, camera_path(times, preset.duration_s, seed, preset.approach_m)


def frame_times(count: int, duration_s: float, seed: int) -> np.ndarray:
    """Times [count] of frames taken by hand: uneven, increasing, whole milliseconds, from 20 s to duration_s."""
    jitter = torch.rand(count, generator=generator_for(seed, 0, "frame times"), dtype=torch.float64).numpy()
    moments = np.arange(count) + 0.6 * (jitter - 0.5)
    moments = np.clip(moments, 0.0, count - 1) / max(count - 1, 1)
    return np.round(_FIRST_FRAME_S + moments**_HASTE * (duration_s - _FIRST_FRAME_S), 3)


def camera_path(times_s: np.ndarray, duration_s: float, seed: int, approach_m: float = 0.15) -> Tensor:
    """World-to-camera matrices [F, 4, 4] of a hand that sweeps to and fro before the objects.

    Every direction is visited several times during the record, so that a view does not tell the time.
    """
    sway = _swaying(torch.from_numpy(times_s) / duration_s, generator_for(seed, 0, "camera path"))

    azimuth = torch.deg2rad(33.0 * sway(5.3) + 2.0 * sway(23.0))
    elevation = torch.deg2rad(26.0 + 9.0 * sway(3.4) + 1.5 * sway(19.0))
    radius = 2.2 + approach_m * sway(2.3)
    roll = torch.deg2rad(2.0 * sway(11.0))
    aim = torch.tensor(_LOOK_AT, dtype=torch.float64) + 0.05 * torch.stack([sway(7.0), sway(9.0), sway(13.0)], dim=1)
    return looking(_around(aim, azimuth, elevation, radius), aim, roll)


def swung(preset: Preset, frames: int, seed: int) -> tuple[np.ndarray, Tensor]:
    """Times [F] and world-to-camera matrices [F, 4, 4] of a video by a hand that swings the camera."""
    times = _FIRST_FRAME_S + np.arange(frames) / preset.video_hz
    return times, swung_path(torch.from_numpy(times), seed)


def swung_path(times_s: Tensor, seed: int) -> Tensor:
    """World-to-camera matrices [n, 4, 4], at any moments, of a hand that swings the camera once or twice a second."""
    sway = _swaying(times_s, generator_for(seed, 0, "camera swing"))
    azimuth = torch.deg2rad(20.0 * sway(0.7))
    elevation = torch.deg2rad(28.0 + 7.0 * sway(0.9))
    radius = 2.2 + 0.15 * sway(0.8)
    roll = torch.deg2rad(3.0 * sway(1.1))
    aim = torch.tensor(_LOOK_AT, dtype=torch.float64) + 0.35 * torch.stack([sway(1.4), sway(1.0), sway(1.6)], dim=1)
    return looking(_around(aim, azimuth, elevation, radius), aim, roll)


def _swaying(t: Tensor, generator: torch.Generator) -> Callable[[float], Tensor]:
    """Sines over ``t`` of so many cycles in a unit of it, each with a phase of its own."""

    def sway(cycles: float) -> Tensor:
        phase = torch.rand((), generator=generator, dtype=torch.float64)
        return torch.sin(2.0 * math.pi * (cycles * t + phase))

    return sway


def _around(aim: Tensor, azimuth: Tensor, elevation: Tensor, radius: Tensor) -> Tensor:
    """Positions [n, 3] so far from ``aim`` [n, 3] in such directions."""
    flat = radius * torch.cos(elevation)
    return aim + torch.stack(
        [flat * torch.sin(azimuth), -flat * torch.cos(azimuth), radius * torch.sin(elevation)], dim=1
    )


def looking(center: Tensor, aim: Tensor, roll: Tensor | None = None) -> Tensor:
    """World-to-camera matrices [n, 4, 4] of cameras at ``center`` [n, 3] that look at ``aim`` [n, 3], z upwards in the image but
    for a turn about the line of sight by ``roll`` [n] in radians."""
    forward = torch.nn.functional.normalize(aim - center, dim=1)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(forward)
    right = torch.nn.functional.normalize(torch.linalg.cross(forward, up), dim=1)
    down = torch.linalg.cross(forward, right)
    if roll is not None:
        c, s = torch.cos(roll)[:, None], torch.sin(roll)[:, None]
        right, down = c * right + s * down, c * down - s * right
    rotation = torch.stack([right, down, forward], dim=1)
    viewmats = torch.eye(4, dtype=torch.float64).repeat(len(center), 1, 1)
    viewmats[:, :3, :3] = rotation
    viewmats[:, :3, 3] = -(rotation @ center[:, :, None])[:, :, 0]
    return viewmats
