"""All scores of an image, and their mean over images."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from heatsplat.contracts import ThermalRange
from heatsplat.metrics.definitions import DEFINITIONS, OUTLIER_C
from heatsplat.metrics.lpips import Lpips
from heatsplat.metrics.mae import mae_c
from heatsplat.metrics.mae_roi import mae_roi_image_c, mae_roi_scene_c
from heatsplat.metrics.psnr import psnr
from heatsplat.metrics.ssim import ssim
from heatsplat.metrics.valid import saturated_fraction, valid_pixels


@dataclass(frozen=True)
class Scorer:
    """Computes every score of one image.

    Args:
        thermal_range: temperatures of 0 and 1, or None where image values are no temperatures.
        threshold: Otsu threshold of the scene in [0, 1] (``scene_threshold``), or None.
        cold: the scene's object is colder than its surroundings.
        lpips: the network, or None where it is not available.
    """

    thermal_range: ThermalRange | None = None
    threshold: float | None = None
    cold: bool = False
    lpips: Lpips | None = None

    @torch.no_grad()
    def __call__(self, prediction: Tensor, target: Tensor, mask: Tensor | None = None) -> dict[str, float | None]:
        """Scores by name, in the order of DEFINITIONS, then which pixels they stand for; None where one does not exist.

        Args:
            prediction, target: [H, W, C] in [0, 1].
            mask: [H, W] bool, True where a pixel counts.
        """
        scores: dict[str, float | None] = dict.fromkeys(DEFINITIONS)
        scores["psnr"] = psnr(prediction, target, mask)
        scores["ssim"] = ssim(prediction, target, mask)
        if self.lpips is not None:
            scores["lpips"] = self.lpips(prediction, target, mask)
        if self.thermal_range is not None and target.shape[-1] == 1:
            for suffix, outlier_c in (("", None), ("_inlier", OUTLIER_C)):
                common = (prediction, target, self.thermal_range)
                scores[f"mae{suffix}_c"] = mae_c(*common, mask, outlier_c)
                scores[f"mae_roi{suffix}_c"] = mae_roi_image_c(*common, mask, outlier_c)
                if self.threshold is not None:
                    scores[f"mae_roi_scene{suffix}_c"] = mae_roi_scene_c(
                        *common, self.threshold, self.cold, mask, outlier_c
                    )
        valid = valid_pixels(prediction, target, mask)
        scores["counted"] = valid.double().mean().item()
        scores["saturated"] = saturated_fraction(target, valid)
        return scores


def mean_of_images(rows: Sequence[Mapping[str, float | None]], name: str) -> float | None:
    """Mean of a score over the images that have it; None if none has it."""
    values = [row[name] for row in rows if row[name] is not None]
    return math.fsum(values) / len(values) if values else None
