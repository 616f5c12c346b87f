"""The loss of a run: named terms, each times a weight and a schedule, on or absent."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from heatsplat.contracts import Camera, SceneData, View
from heatsplat.geometry.resampling import resampled
from heatsplat.losses.masking import cleared
from heatsplat.splats import Splats


@dataclass(frozen=True)
class LossInputs:
    """What a loss term may look at in one training step.

    Args:
        prediction: [H, W, C] image after the sensor, with a gradient.
        target: [H, W, C] image to reproduce, in [0, 1]; constant. Any value, NaN too, where the mask is False.
        mask: [H, W] bool, True where a pixel counts; None means that all do.
        view: the view that the images belong to.
        splats: the Gaussians.
        step: training step, from 0.
        progress: share of the run that is done, in [0, 1] (``Schedule.progress``).
        companions: prediction and target of the further images that the model explains, by modality.
        ratio: how many pixels of full size fit beside one of the prediction (``Resolution.ratio``).
    """

    prediction: Tensor
    target: Tensor
    mask: Tensor | None
    view: View
    splats: Splats
    step: int = 0
    progress: float = 0.0
    companions: Mapping[str, tuple[Tensor, Tensor]] = field(default_factory=dict)
    ratio: float = 1.0

    def pair(self, modality: str | None) -> tuple[Tensor, Tensor]:
        """Prediction and target of a companion, or of the image itself for None.

        Raises:
            ValueError: the model does not explain that modality.
        """
        if modality is None:
            return self.prediction, self.target
        if modality not in self.companions:
            there = ", ".join(self.companions) or "none"
            raise ValueError(
                f"a loss term asks for {modality} images, which the model does not explain (it has: {there})"
            )
        return self.companions[modality]

    def unmasked(self) -> tuple[Tensor, Tensor]:
        """Prediction and target with 0 where the mask is False, through which no gradient goes.

        Raises:
            ValueError: they differ in shape.
        """
        if self.prediction.shape != self.target.shape:
            raise ValueError(
                f"prediction and target must have one shape, got {list(self.prediction.shape)} and "
                f"{list(self.target.shape)}"
            )
        return cleared(self.prediction, self.mask), cleared(self.target, self.mask)


@torch.no_grad()
def pixel_errors(inputs: LossInputs, camera: Camera) -> Tensor:
    """Absolute error of each pixel in image units, mean over the channels of all images; 0 where the mask is False.

    **Convention:** errors are those of the target's pixels, area averages of the prediction where that is finer; they are
    given on the grid of ``camera``, [H, W].
    """
    pairs = [(inputs.prediction, inputs.target), *inputs.companions.values()]
    total, channels = 0.0, 0
    for prediction, target in pairs:
        seen = resampled(prediction, *target.shape[:2], "area")
        total = total + (seen - target).abs().sum(-1)
        channels += target.shape[-1]
    error = total / channels
    if inputs.mask is not None:
        error = torch.where(inputs.mask, error, 0.0)
    return resampled(error[..., None], camera.height, camera.width, "area")[..., 0]


@torch.no_grad()
def known_target(inputs: LossInputs, camera: Camera) -> Tensor:
    """The target on the grid of ``camera``, its own or one finer by a whole factor, [H, W, C]; NaN where the mask is False."""
    height, width = camera.height, camera.width
    target = resampled(cleared(inputs.target, inputs.mask), height, width, "area")
    if inputs.mask is None:
        return target
    return target.where(resampled(inputs.mask[..., None].to(target), height, width, "area") > 0.5, torch.nan)


class LossTerm(ABC):
    """One way to compare: from the inputs to one weighted scalar, or to several by name. An empty dict is no term.

    Attributes:
        modality: the companion whose images are compared, such as "rgb"; None where it is the model's own image, or none.
    """

    modality: str | None = None

    def counts(self, step: int, progress: float) -> bool:
        """Whether the term counts at a step of the run, as far as that is known before training."""
        return True

    def prepare(self, scene: SceneData, modality: str) -> dict[str, str]:
        """Checks and computes, once before training, what it needs of the scene; what the report should say of it, by name."""
        return {}

    @abstractmethod
    def __call__(self, inputs: LossInputs) -> Tensor | dict[str, Tensor]: ...


class Wrapped(LossTerm):
    """A term around another one, which it passes on what it does not change.

    Args:
        term: the other one.
    """

    def __init__(self, term: LossTerm) -> None:
        self.term = term

    @property
    def modality(self) -> str | None:
        return self.term.modality

    def counts(self, step: int, progress: float) -> bool:
        return self.term.counts(step, progress)

    def prepare(self, scene: SceneData, modality: str) -> dict[str, str]:
        return self.term.prepare(scene, modality)

    def __call__(self, inputs: LossInputs) -> Tensor | dict[str, Tensor]:
        return self.term(inputs)


class Weighted(Wrapped):
    """A term times a weight and a schedule; at weight zero the term is neither prepared nor evaluated.

    Args:
        term: what is weighted.
        weight: factor.
        schedule: factor as a function of progress (heatsplat.losses.schedules), or None for constant 1.
    """

    def __init__(self, term: LossTerm, weight: float = 1.0, schedule: Callable[[float], float] | None = None) -> None:
        super().__init__(term)
        self.weight, self.schedule = weight, schedule

    @property
    def modality(self) -> str | None:
        return self.term.modality if self.weight != 0.0 else None

    def prepare(self, scene: SceneData, modality: str) -> dict[str, str]:
        return self.term.prepare(scene, modality) if self.weight != 0.0 else {}

    def counts(self, step: int, progress: float) -> bool:
        return self._factor(progress) != 0.0 and self.term.counts(step, progress)

    def __call__(self, inputs: LossInputs) -> dict[str, Tensor]:
        factor = self._factor(inputs.progress)
        return {} if factor == 0.0 else scaled(self.term, inputs, factor)

    def _factor(self, progress: float) -> float:
        return self.weight if self.schedule is None else self.weight * self.schedule(progress)


class During(Wrapped):
    """A term that counts at some steps of the run only; at others it is not even evaluated.

    Args:
        term: what counts.
        start: first step.
        stop: the step before which it ends; None is the end of the run.
    """

    def __init__(self, term: LossTerm, start: int = 0, stop: int | None = None) -> None:
        super().__init__(term)
        self.start, self.stop = start, math.inf if stop is None else stop

    def counts(self, step: int, progress: float) -> bool:
        return self.start <= step < self.stop and self.term.counts(step, progress)

    def __call__(self, inputs: LossInputs) -> Tensor | dict[str, Tensor]:
        return self.term(inputs) if self.start <= inputs.step < self.stop else {}


class Loss:
    """The weighted scalars of all terms by name; their sum is the loss.

    Args:
        terms: name -> term, or None for a term that is absent.

    Raises:
        ValueError: there is no term, or one is no ``LossTerm``.
    """

    def __init__(self, terms: Mapping[str, LossTerm | None]) -> None:
        self.terms = {name: term for name, term in terms.items() if term is not None}
        if not self.terms:
            raise ValueError(f"the loss has no term: give one of loss.terms ({', '.join(terms)}) that is not null")
        for name, term in self.terms.items():
            _check_term(name, term)

    def check(self, progress: Sequence[float]) -> None:
        """Raises ValueError where no term counts at some step of a run; ``progress`` is that at each of its steps."""
        moments = list(enumerate(progress))
        for step, share in moments:
            if any(term.counts(step, share) for term in self.terms.values()):
                continue
            told = []
            for name, term in self.terms.items():
                steps = [at for at, done in moments if term.counts(at, done)]
                told.append(f"{name} from {steps[0]} to {steps[-1]}" if steps else f"{name} never")
            raise ValueError(
                f"no term of the loss counts at step {step} of 0 to {moments[-1][0]}; change start, stop, weight or schedule in "
                f"loss.terms: {', '.join(told)}"
            )

    def prepare(self, scene: SceneData, modality: str) -> dict[str, str]:
        """Lets terms check and compute what they need of a scene; what the report should say of them, by name."""
        notes: dict[str, str] = {}
        for term in self.terms.values():
            notes |= term.prepare(scene, modality)
        return notes

    def compares(self, companion: str) -> bool:
        """Whether some term compares the images of a companion."""
        return any(term.modality == companion for term in self.terms.values())

    def __call__(self, inputs: LossInputs) -> dict[str, Tensor]:
        """Scalars by name: ``name`` of a term that returns a tensor, ``name/part`` of one that returns several."""
        scalars: dict[str, Tensor] = {}
        for name, term in self.terms.items():
            for part, value in _named(term, inputs).items():
                scalars[f"{name}/{part}" if part else name] = value
        return scalars


def summands(*parts: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The terms of several parts of a run by name, scalars whose sum is minimised.

    Raises:
        ValueError: two are called the same, or one is no scalar tensor; the message names it. Or there is none.
    """
    terms: dict[str, Tensor] = {}
    for part in parts:
        for name, value in part.items():
            if name in terms:
                raise ValueError(
                    f"two loss terms are called '{name}': a term of the loss, or a regulariser of the thermal model, the sensor "
                    "or the cameras, needs another name"
                )
            _check_scalar(f"loss term '{name}'", value)
            terms[name] = value
    if not terms:
        raise ValueError(
            "every term of loss.terms is absent at this step, so nothing is minimised: add one that counts"
        )
    return terms


def scaled(term: LossTerm, inputs: LossInputs, factor: Tensor | float) -> dict[str, Tensor]:
    """A term's values by name, times a factor."""
    return {name: factor * value for name, value in _named(term, inputs).items()}


def _named(term: LossTerm, inputs: LossInputs) -> dict[str, Tensor]:
    """A term's values by name; a lone scalar has the empty name. Raises ValueError where one is no scalar."""
    values = term(inputs)
    named = values if isinstance(values, dict) else {"": values}
    for value in named.values():
        _check_scalar(f"what loss term {type(term).__name__} returned", value)
    return named


def _check_term(name: str, term: object) -> None:
    """Raises ValueError where a term, or one that others are around, is no ``LossTerm``."""
    while isinstance(term, Wrapped):
        name, term = f"{name}.term", term.term
    if not isinstance(term, LossTerm):
        raise ValueError(
            f"loss.terms.{name} is {_shown(term)}; a loss term derives from heatsplat.losses.compose.LossTerm, and its __call__ "
            "compares images"
        )


def _check_scalar(what: str, value: object) -> None:
    if not isinstance(value, Tensor) or value.numel() != 1:
        raise ValueError(f"{what} is {_shown(value)}; it must be a scalar tensor, such as a mean over pixels")


def _shown(value: object) -> str:
    """What something out of place is, for messages."""
    if isinstance(value, Tensor):
        return f"a tensor of shape {list(value.shape)}"
    return "None" if value is None else f"of type {type(value).__name__}"
