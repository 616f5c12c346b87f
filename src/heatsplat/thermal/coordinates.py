"""Where a moment, a place and a value lie in a scene, as constants of a model that travel in its checkpoints."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData, ThermalRange
from heatsplat.physics.units import DAY_S, kelvin

BOX_EDGE = 0.9  # places end here: the code of ``octaves`` has period 2 and would repeat from 1 on
FIELD_BOX = 1.2  # edges of the box of a field over those of the points' central 98 %


class Clock(nn.Module):
    """The record of the training images: its first moment and its span in seconds."""

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Clock:
        """Stays on the CPU, where every step reads it: a number on a GPU is waited for."""
        return self

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("record", torch.tensor([0.0, 1.0], dtype=torch.float64))

    def prepare(self, scene: SceneData) -> None:
        self.record.copy_(torch.tensor(scene.record, dtype=torch.float64))

    @property
    def first_s(self) -> float:
        return float(self.record[0])

    @property
    def span_s(self) -> float:
        return float(self.record[1])

    def spans(self, time_s: float | None) -> float:
        """Time since the first image in spans of the record: 0 at the first image, 1 at the last.

        Raises:
            ValueError: there is no time.
        """
        if time_s is None:
            raise ValueError("a scene that changes needs the time at which it is seen: give time_s")
        first, span = self.record.tolist()
        return (float(time_s) - first) / span

    def within(self, time_s: float | None) -> float:
        """As ``spans``, of the moment of the record that is nearest: 0 to 1."""
        return min(max(self.spans(time_s), 0.0), 1.0)


class Box(nn.Module):
    """The cube about the central 98 % of a scene's points: centre, and edge in world units."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("edge", torch.ones(()))

    def prepare(self, scene: SceneData) -> None:
        center, edge = scene.bulk
        self.center.copy_(center)
        self.edge.fill_(edge)

    def places(self, means: Tensor) -> Tensor:
        """Positions [n, 3] from the centre in edges, within ± ``BOX_EDGE``."""
        return ((means - self.center) / self.edge).clamp(-BOX_EDGE, BOX_EDGE)


class ImageRange(nn.Module):
    """The temperatures that image values 0 and 1 stand for; unknown in a scene without a range."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("range_c", torch.full((2,), torch.nan, dtype=torch.float64))

    def prepare(self, scene: SceneData) -> None:
        if scene.thermal_range is not None:
            bounds = [scene.thermal_range.min_c, scene.thermal_range.max_c]
            self.range_c.copy_(torch.tensor(bounds, dtype=torch.float64))

    @property
    def bounds(self) -> ThermalRange | None:
        return None if self.range_c.isnan().any() else ThermalRange(*self.range_c.tolist())

    @property
    def lowest_k(self) -> float:
        """Temperature in kelvin of image value 0."""
        return kelvin(self.bounds.min_c)

    def kelvin(self, units: Tensor) -> Tensor | None:
        """Temperatures in kelvin of image values, any shape; None where they are unknown."""
        return None if self.bounds is None else self.lowest_k + self.bounds.span_k * units


def sees_hours(time: str, scene: SceneData) -> bool:
    """Whether a network sees the hour of the day, not the share of the record that has passed.

    Args:
        time: "day", "record", "none", or "scene": where the weather record is longer than a day, so that hours come again.
    """
    weather = scene.weather
    longer = weather is not None and float(weather.times_s[-1] - weather.times_s[0]) > DAY_S
    return time == "day" or (time == "scene" and longer)


def octaves(values: Tensor, count: int, slow: Tensor | None = None) -> Tensor:
    """sin(2^k π p) and cos(2^k π p) of every column p for k below ``count``, [n, 2 count D] (TI-3DGS, Eq. 11).

    Multiples of the period are taken away before π comes in, which is exact; sin(2^9 π p) taken directly has lost three
    digits to the rounding of its argument.

    Args:
        values: [n, D].
        count: octaves.
        slow: [] how many of them are there (``slow_octaves``), the others are 0; None is all.
    """
    scaled = values[:, :, None] * 2.0 ** torch.arange(count, dtype=values.dtype, device=values.device)
    phase = math.pi * (scaled - 2.0 * torch.round(scaled / 2.0))
    if slow is not None:
        seen = torch.arange(count, device=values.device) < slow.to(values.device)
        return torch.cat((phase.sin() * seen, phase.cos() * seen), 2).flatten(1)
    return torch.cat((phase.sin(), phase.cos()), 2).flatten(1)


def check_frames_per_cycle(value: float | None) -> None:
    """Raises ValueError where images to a cycle are not positive, or None."""
    if value is not None and not value > 0:
        raise ValueError(f"frames_per_cycle must be positive or null, got {value}")


def slow_octaves(count: int, frames: int, frames_per_cycle: float | None, slowest: float) -> int:
    """How many of ``count`` octaves of time have cycles long enough for images to tell, at least one.

    Args:
        frames: images of the record.
        frames_per_cycle: images to a cycle of the fastest octave, at least; None takes all octaves.
        slowest: cycles of the first octave over the record.
    """
    if frames_per_cycle is None:
        return count
    return min(count, 1 + math.floor(math.log2(max((frames - 1) / frames_per_cycle / slowest, 1.0))))
