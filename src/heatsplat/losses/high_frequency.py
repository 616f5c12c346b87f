"""SupIR-GS's high-frequency loss: fine detail of a teacher, where the teacher can be trusted."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn import functional

from heatsplat.contracts import SceneData
from heatsplat.geometry.resampling import resampled
from heatsplat.losses.compose import LossInputs, LossTerm
from heatsplat.losses.low_resolution import check_fineness, counted_finely
from heatsplat.losses.masking import masked_mean
from heatsplat.losses.sobel import GAIN, sobel
from heatsplat.losses.teacher import Teacher, TeacherImages


class HighFrequency(LossTerm):
    """The mean of W |H(prediction) - H(teacher)| on the fine grid of the prediction (SupIR-GS, Eq. 9-10).

    H is what lies between two averages and W, the confidence, falls where the teacher departs from the target. Both are
    made once per training image and kept in half precision (4 bytes per pixel and channel). Where a masked pixel of the
    target is near, nothing counts. Below full size (``inputs.ratio``) there is no such detail, and the term is absent.

    Args:
        teacher: gives where fine images come from; called when the first is needed, so that only training loads it.
        factor: how much finer than the training images the prediction is.
        gamma_pixel, gamma_gradient: how fast confidence falls with |teacher - enlarged target| and with the sum of the
            differences of their slopes per pixel.
        inner, outer: sides of the averaging windows of H, odd; 1 is the image itself.

    Raises:
        ValueError: a window is not odd or they are not in order; or, when called, the prediction has another factor.
    """

    def __init__(
        self,
        teacher: Callable[[], Teacher],
        factor: int = 4,
        gamma_pixel: float = 10.0,
        gamma_gradient: float = 5.0,
        inner: int = 1,
        outer: int = 7,
    ) -> None:
        if not 1 <= inner < outer or inner % 2 == 0 or outer % 2 == 0:
            raise ValueError(f"inner and outer are odd sides of windows, the first smaller, got {inner} and {outer}")
        if min(gamma_pixel, gamma_gradient) < 0 or factor < 1:
            raise ValueError(
                "gamma_pixel and gamma_gradient must not be negative and factor at least 1, "
                f"got {gamma_pixel}, {gamma_gradient}, {factor}"
            )
        self.factor = factor
        self._teacher_images = TeacherImages(
            teacher, factor, lambda fine, target: (self.detail(fine), self.confidence(fine, target))
        )
        self.gamma_pixel, self.gamma_gradient = gamma_pixel, gamma_gradient
        self.inner, self.outer = inner, outer

    def prepare(self, scene: SceneData, modality: str) -> dict[str, str]:
        """Asks the teacher for the images of a scene; see ``TeacherImages.prepare``."""
        return self._teacher_images.prepare(scene, modality)

    def __call__(self, inputs: LossInputs) -> Tensor | dict[str, Tensor]:
        check_fineness(inputs, self.factor)
        if inputs.ratio > 1:
            return {}
        detail, confidence = (
            made.to(inputs.prediction) for made in self._teacher_images.of(inputs.view, inputs.target)
        )
        error = confidence * (self.detail(inputs.prediction) - detail).abs()
        return masked_mean(error, None if inputs.mask is None else counted_finely(inputs.mask, self.factor))

    def detail(self, image: Tensor) -> Tensor:
        """H: the average over the inner window minus that over the outer one, [H, W, C]; 0 for a flat image."""
        return averaged(image, self.inner) - averaged(image, self.outer)

    def confidence(self, fine: Tensor, coarse: Tensor) -> Tensor:
        """W of a teacher's image [fH, fW, C] of a target [H, W, C], [fH, fW, 1] in (0, 1]."""
        enlarged = resampled(coarse, *fine.shape[:2], "bilinear")
        slopes = zip(sobel(fine), sobel(enlarged), strict=True)
        gradient = sum((a - b).abs() for a, b in slopes) / GAIN
        departure = self.gamma_pixel * (fine - enlarged).abs() + self.gamma_gradient * gradient
        return torch.exp(-departure.mean(2, keepdim=True))


def averaged(image: Tensor, side: int) -> Tensor:
    """Means over windows of ``side`` x ``side`` pixels, [H, W, C]; at the border over what lies inside."""
    if side == 1:
        return image
    planes = image.permute(2, 0, 1)[None]
    means = functional.avg_pool2d(planes, side, stride=1, padding=side // 2, count_include_pad=False)
    return means[0].permute(1, 2, 0)
