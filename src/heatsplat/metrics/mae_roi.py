"""Mean absolute error of temperature in the region of interest, as two papers define it.

They share the idea (Otsu's threshold on the ground truth) and differ in everything else, so each has its own name here:

* SupIR-GS: a threshold per image; heated objects are what lies above it. Its tables also drop errors above 10 °C.
* ThermoNeRF: one threshold for the scene, the mean over all its frames of their thresholds; the foreground lies above
  it, or below it in scenes whose object is colder than its surroundings.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from heatsplat.contracts import ThermalRange
from heatsplat.metrics.mae import mae_c
from heatsplat.metrics.otsu import LEVELS, grey_levels, otsu_level


def mae_roi_image_c(
    prediction: Tensor,
    target: Tensor,
    thermal_range: ThermalRange,
    mask: Tensor | None = None,
    outlier_c: float | None = None,
) -> float | None:
    """Temperature error in °C above this image's own Otsu threshold (SupIR-GS); None where there is no such region.

    Args:
        prediction, target: [H, W, 1] in [0, 1].
        thermal_range: the temperatures of 0 and 1.
        mask: [H, W] bool, True where a pixel counts; also for the threshold.
        outlier_c: pixels with a larger error are dropped (the paper: 10).
    """
    level = otsu_level(target, mask)
    if level is None:
        return None
    region = grey_levels(target[..., 0].nan_to_num()) > level
    return mae_c(prediction, target, thermal_range, region if mask is None else region & mask, outlier_c)


def scene_threshold(targets: Iterable[tuple[Tensor, Tensor | None]]) -> float | None:
    """The scene's threshold in [0, 1]: the mean of its images' Otsu thresholds (ThermoNeRF); None if no image has one.

    Constant images have no threshold and are left out of the mean.

    Args:
        targets: pairs of an image [H, W, 1] in [0, 1] and its mask [H, W] or None, for all frames of the scene.
    """
    levels = [level for image, mask in targets if (level := otsu_level(image, mask)) is not None]
    return sum(levels) / len(levels) / LEVELS if levels else None


def mae_roi_scene_c(
    prediction: Tensor,
    target: Tensor,
    thermal_range: ThermalRange,
    threshold: float,
    cold: bool = False,
    mask: Tensor | None = None,
    outlier_c: float | None = None,
) -> float | None:
    """Temperature error in °C on one side of the scene's threshold (ThermoNeRF); None where no pixel lies there.

    Args:
        prediction, target: [H, W, 1] in [0, 1].
        thermal_range: the temperatures of 0 and 1.
        threshold: of the scene, in [0, 1], from ``scene_threshold``.
        cold: the foreground is colder than the threshold.
        mask: [H, W] bool, True where a pixel counts.
        outlier_c: pixels with a larger error are dropped (no part of ThermoNeRF's definition).
    """
    values = target[..., 0]
    region = values < threshold if cold else values > threshold
    region = region & torch.isfinite(values)
    return mae_c(prediction, target, thermal_range, region if mask is None else region & mask, outlier_c)
