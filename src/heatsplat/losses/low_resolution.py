"""Comparing a finely rendered image with a coarsely recorded one, on the grid of the target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from torch import Tensor

from heatsplat.contracts import SceneData, check_option
from heatsplat.geometry.resampling import KERNELS, resampled, scale_between
from heatsplat.losses.compose import LossInputs, LossTerm, Wrapped
from heatsplat.losses.masking import eroded
from heatsplat.losses.photometric import Photometric


class OnTargetGrid(Wrapped):
    """A term of the predictions reduced to the grids of their targets: consistency with what was recorded.

    A prediction that has its target's size already is passed on as it is.

    Args:
        term: what compares.
        kernel: how the prediction shrinks; None: as the training images lost their resolution (``SceneData.reduced_by``),
            or "area" where the camera itself is coarse, since a detector averages over its area.

    Raises:
        ValueError: the kernel is unknown; or, when called, the prediction is not finer by a whole factor.
    """

    def __init__(self, term: LossTerm, kernel: str | None = None) -> None:
        if kernel is not None:
            check_option("kernel", kernel, KERNELS)
        super().__init__(term)
        self.kernel = kernel or "area"
        self._follows = kernel is None

    def prepare(self, scene: SceneData, modality: str) -> dict[str, str]:
        """Prepares the term, and finds the kernel where none is given."""
        if self._follows:
            self.kernel = scene.reduced_by or "area"
        return super().prepare(scene, modality)

    def __call__(self, inputs: LossInputs) -> Tensor | dict[str, Tensor]:
        fineness(inputs)
        companions = {name: (self._reduced(*pair), pair[1]) for name, pair in inputs.companions.items()}
        prediction = self._reduced(inputs.prediction, inputs.target)
        return self.term(replace(inputs, prediction=prediction, companions=companions))

    def _reduced(self, prediction: Tensor, target: Tensor) -> Tensor:
        return resampled(prediction, *target.shape[:2], self.kernel)


class Curriculum(LossTerm):
    """The terms "l1" and "dssim": (1 + b(t)) mean|x - y| and s(t) (1 - mean SSIM) (SupIR-GS, Eq. 12, first two terms).

    Unlike in ``Photometric``, SSIM comes on top of the L1 term and not out of it.

    Args:
        ssim_weight: s at the end of its ramp.
        ssim_schedule: ramp of s as a function of progress (``losses.schedules``), or None for constant.
        boost_weight: b at the end of its ramp; the paper names late-stage boosting terms without saying what they are.
        boost_schedule: ramp of b, or None for constant.

    Raises:
        ValueError: a weight is negative.
    """

    def __init__(
        self,
        ssim_weight: float = 0.2,
        ssim_schedule: Callable[[float], float] | None = None,
        boost_weight: float = 0.0,
        boost_schedule: Callable[[float], float] | None = None,
    ) -> None:
        if min(ssim_weight, boost_weight) < 0:
            raise ValueError(f"ssim_weight and boost_weight must not be negative, got {ssim_weight}, {boost_weight}")
        self.ssim_weight, self.ssim_schedule = ssim_weight, ssim_schedule
        self.boost_weight, self.boost_schedule = boost_weight, boost_schedule
        self._plain, self._halves = Photometric(0.0), Photometric(0.5)

    def __call__(self, inputs: LossInputs) -> dict[str, Tensor]:
        structure = self.ssim_weight * (self.ssim_schedule(inputs.progress) if self.ssim_schedule else 1.0)
        boost = self.boost_weight * (self.boost_schedule(inputs.progress) if self.boost_schedule else 1.0)
        if structure == 0.0:
            return {"l1": (1.0 + boost) * self._plain(inputs)["l1"]}
        halves = self._halves(inputs)
        return {"l1": 2.0 * (1.0 + boost) * halves["l1"], "dssim": 2.0 * structure * halves["dssim"]}


def fineness(inputs: LossInputs) -> int:
    """The whole number by which the prediction's grid is finer than the target's.

    Raises:
        ValueError: there is none, with both sizes.
    """
    fine, coarse = tuple(inputs.prediction.shape[:2]), tuple(inputs.target.shape[:2])
    factor = scale_between(fine, coarse)
    if factor is None:
        raise ValueError(
            f"the prediction has {fine[1]} x {fine[0]} pixels and the target {coarse[1]} x {coarse[0]}: the first must "
            "be a whole multiple of the second (module.supersample: how much finer than training images is rendered)"
        )
    return factor


def check_fineness(inputs: LossInputs, factor: int) -> None:
    """Raises ValueError where the prediction, at full size, is not ``factor`` times as fine as the target.

    Below full size (``inputs.ratio``) it is less fine by the ratio, down to as fine as the target.
    """
    expected = max(factor / inputs.ratio, 1.0)
    if fineness(inputs) != expected:
        raise ValueError(
            f"the prediction is {fineness(inputs)} times as fine as the training image, the loss expects {expected:g}; set "
            "both by super_resolution"
        )


def counted_finely(mask: Tensor, factor: int) -> Tensor:
    """Which pixels of a fine grid [factor H, factor W] count: those in a pixel of [H, W] with no masked one about it."""
    return eroded(mask).repeat_interleave(factor, 0).repeat_interleave(factor, 1)
