"""SRGS's loss: the fine prediction is to look like a teacher's image, and, made small, like the target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from torch import Tensor

from heatsplat.contracts import SceneData
from heatsplat.geometry.resampling import resampled
from heatsplat.losses.compose import LossInputs, LossTerm
from heatsplat.losses.low_resolution import OnTargetGrid, check_fineness, counted_finely, fineness
from heatsplat.losses.photometric import Photometric
from heatsplat.losses.teacher import Teacher, TeacherImages


class TeacherAndTarget(LossTerm):
    """(1 - w) L(prediction, teacher) + w L(small prediction, target), L = 0.8 L1 + 0.2 (1 - SSIM) (Feng et al. 2024).

    The terms are "teacher/l1", "teacher/dssim", "target/l1" and "target/dssim", weighted; a share of zero leaves its pair
    out. Near masked pixels of the target the teacher's image does not count: there it is a guess from half a picture.
    Below full size (``inputs.ratio``) it is averaged to the prediction's grid.

    Args:
        teacher: gives where fine images come from; called when the first is needed, so that only training loads it.
        factor: how much finer than the training images the prediction is.
        target_weight: w in [0, 1].
        sr_only: learns from the teacher alone, as the published repository does; w then counts as 0.
        kernel: how the prediction is made small ("area": averages, as published).
        dssim_weight: share of SSIM in L.

    Raises:
        ValueError: w is outside [0, 1] or the factor below 1; or, when called, the prediction has another factor.
    """

    def __init__(
        self,
        teacher: Callable[[], Teacher],
        factor: int = 4,
        target_weight: float = 0.6,
        sr_only: bool = False,
        kernel: str = "area",
        dssim_weight: float = 0.2,
    ) -> None:
        if not 0.0 <= target_weight <= 1.0 or factor < 1:
            raise ValueError(
                f"target_weight is a share of the loss in [0, 1] and factor at least 1, got {target_weight}, {factor}"
            )
        self.factor = factor
        self.target_weight = 0.0 if sr_only else target_weight
        self._compare = Photometric(dssim_weight)
        self._on_target = OnTargetGrid(self._compare, kernel)
        self._teacher_images = TeacherImages(teacher, factor, lambda fine, target: (fine,))

    def prepare(self, scene: SceneData, modality: str) -> dict[str, str]:
        """Asks the teacher for the images of a scene (``TeacherImages.prepare``), unless w = 1 asks for none."""
        return self._teacher_images.prepare(scene, modality) if self.target_weight < 1.0 else {}

    def __call__(self, inputs: LossInputs) -> dict[str, Tensor]:
        check_fineness(inputs, self.factor)
        terms: dict[str, Tensor] = {}
        if self.target_weight < 1.0:
            (fine,) = (kept.to(inputs.prediction) for kept in self._teacher_images.of(inputs.view, inputs.target))
            fine = resampled(fine, *inputs.prediction.shape[:2], "area")
            mask = None if inputs.mask is None else counted_finely(inputs.mask, fineness(inputs))
            taught = self._compare(replace(inputs, target=fine, mask=mask))
            terms |= {f"teacher/{name}": (1.0 - self.target_weight) * value for name, value in taught.items()}
        if self.target_weight > 0.0:
            reduced = self._on_target(inputs)
            terms |= {f"target/{name}": self.target_weight * value for name, value in reduced.items()}
        return terms
