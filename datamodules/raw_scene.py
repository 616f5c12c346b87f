"""A scene as a loader found it, before anything is resampled, shifted or split, and what a user asks of it."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from torch import Tensor

from heatsplat.contracts import Environment, SceneError, ThermalRange, Weather, check_count
from heatsplat.datamodules.formats.lens import Lens
from heatsplat.datamodules.formats.pseudo_colour import PaletteReader
from heatsplat.datamodules.poses import checked_pose
from heatsplat.datamodules.splits import SplitRule


@dataclass(frozen=True)
class RawFrame:
    """One image as a loader found it, before anything is resampled, shifted or split.

    Args:
        name: file name relative to the image folder; splits and messages use it.
        viewmat: world-to-camera [4, 4], OpenCV axes; kept as a float64 array.
        lens: intrinsics and distortion, for whatever image size they were written down for.
        read: returns the stored thermal pixels [H, W] or [H, W, 3 or 4] (RGB, RGBA), uint8, uint16 or float32. Integers
            span their type (0 .. 255 is 0 .. 1) unless the scene has ``Counts``; float32 holds °C, NaN where unknown.
            None for a photo, which ``read_rgb`` returns.
        time_s: seconds on any clock, float64, or None.
        read_rgb: returns a visible image of the same camera, or None.
        read_mask: returns [H, W] bool for the stored thermal image, True where a pixel counts, or None.
        subset: "train" or "test" where the data set itself says so (folder, list), else None.
        environment: weather at that time, or None.
        span: °C of black and white of this image alone, or of what the camera drew before °C were made of it; values at its ends
            are bounds. All frames have one, or none has.
    """

    name: str
    viewmat: np.ndarray
    lens: Lens
    read: Callable[[], np.ndarray] | None
    time_s: float | None = None
    read_rgb: Callable[[], np.ndarray] | None = None
    read_mask: Callable[[], np.ndarray] | None = None
    subset: str | None = None
    environment: Environment | None = None
    span: ThermalRange | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "viewmat", checked_pose(self.viewmat, f"viewmat of frame {self.name}"))


@dataclass(frozen=True)
class Counts:
    """The linear map from stored numbers to temperature: °C = ``scale`` * stored + ``offset_c``."""

    scale: float
    offset_c: float

    def __post_init__(self) -> None:
        if not (0 < self.scale < math.inf and math.isfinite(self.offset_c)):
            raise SceneError(
                f"data.raw_scale must be positive (°C per count), got {self.scale}, and data.raw_offset_c finite, got "
                f"{self.offset_c}"
            )


CELSIUS = Counts(scale=1.0, offset_c=0.0)


@dataclass(frozen=True)
class RawScene:
    """A scene as a loader found it: all that is known of it, on the clock and in the world of its frames.

    Args:
        name: scene name.
        frames: at least one training and one test frame under the split.
        points: [P, 3] in the world of the frames' ``viewmat``, at least 4 finite ones.
        point_colors: [P, 3] in [0, 1], or None.
        thermal_range: bounds in °C; with ``counts`` (or float pixels) and without bounds they are taken from the training
            images. Of frames with spans of their own it is the range that holds these.
        counts: map from stored numbers to °C, for raw sensor data; None when integers span their type.
        ambient_c: temperature of the surroundings, or None.
        metres_per_unit: scale of the world, or None.
        weather: the weather, or None; frames without an environment get theirs from it.
        labels: [P] class of each point, or None.
        point_features: [P, D] features of each point, or None.
        notes: what the loader found, kept and added to.
        probes: [n, 3] in the same world as ``points``, or None.
        truth: function (points [n, 3], times [F]) -> °C [n, F], or None.
        true_attributes: function (points [n, 3]) -> properties by name, each [n], or None.
    """

    name: str
    frames: Sequence[RawFrame]
    points: np.ndarray
    point_colors: np.ndarray | None = None
    thermal_range: ThermalRange | None = None
    counts: Counts | None = None
    ambient_c: float | None = None
    metres_per_unit: float | None = None
    weather: Weather | None = None
    labels: np.ndarray | None = None
    point_features: np.ndarray | None = None
    notes: Mapping[str, Any] = field(default_factory=dict)
    probes: np.ndarray | None = None
    truth: Callable[[Tensor, Tensor], Tensor] | None = None
    true_attributes: Callable[[Tensor], dict[str, Tensor]] | None = None


@dataclass(frozen=True)
class SceneOptions:
    """What a user asks of a scene.

    Args:
        split: which frames are held out.
        downscale: factor >= 1; images become round(W / d) x round(H / d) by area averages.
        thermal_channels: 1, or 3 to keep pseudo-colour (which has no temperature: the range is dropped).
        alpha_mask: True to leave out pixels whose alpha is below one half; otherwise alpha is ignored.
        multiple: of which sides of images are that shrink, as close to W / d and H / d as that allows; 1 for any.
        every: of the training frames of each camera every so many-th is used, in the order of their times (of names without),
            the first one included; test frames are those of ``split``, or where it holds nothing out, some of the frames used.
        palette: of thermal images in pseudo-colour, which makes greys of them; None where there is none to be read.
    """

    split: SplitRule
    downscale: float = 1.0
    thermal_channels: int = 1
    alpha_mask: bool = False
    multiple: int = 1
    every: int = 1
    palette: PaletteReader | None = None

    def __post_init__(self) -> None:
        check_count("data.every", self.every)
        if not self.downscale >= 1:
            raise SceneError(f"data.downscale must be 1 or larger, got {self.downscale}")
        if self.thermal_channels not in (1, 3):
            raise SceneError(f"data.thermal_channels must be 1 or 3, got {self.thermal_channels}")
        if self.palette is not None and self.thermal_channels == 3:
            raise SceneError(
                "data.palette makes one channel of the colours, and data.thermal_channels=3 keeps them: give one of the two"
            )
