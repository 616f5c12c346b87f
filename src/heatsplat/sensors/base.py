"""What a camera does: what adds up in its pixels, and a chain of small parts, each the identity at first and bounded always."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import Any

from torch import Tensor, nn

from heatsplat.contracts import Course, Frame, SceneData


class SensorPart(nn.Module, ABC):
    """One effect of a camera. One part is one file with one subclass and one entry in a list in conf/sensor/.

    Attributes:
        lr: learning rate of its parameters.
        lr_end: factor on it at the last step of the run, log-linear in between.
        weight: of its penalty.
        needs_depth: whether its ``forward`` also takes how far away what is seen is (``heatsplat.sensors.moving``).
    """

    lr: float = 1e-3
    lr_end: float = 1.0
    weight: float = 0.0
    needs_depth: bool = False

    def prepare(self, scene: SceneData, modality: str = "thermal") -> None:
        """Takes sizes (number of frames, image shape) from the scene. Called once, before training.

        Args:
            modality: of the images that the part makes, "thermal" or "rgb": a scene may have both.
        """
        return

    @abstractmethod
    def forward(self, image: Tensor, frame: Frame) -> Tensor:
        """The image that the camera records of the clean ``image`` [H, W, C]; identity before training."""

    def penalty(self) -> Tensor | None:
        """What its parameters cost, a scalar before ``weight``, or None."""
        return None

    def regulariser(self) -> Tensor | None:
        """``weight`` times ``penalty``, which is added to the loss; None without either."""
        penalty = self.penalty() if self.weight else None
        return None if penalty is None else self.weight * penalty

    def effects(self) -> dict[str, dict[str, Any]]:
        """The effects that the part simulates: catalogue name -> settings (for metrics.json)."""
        return {}

    def courses(self) -> list[Course]:
        """What it has learned to change from image to image for all pixels, for a picture."""
        return []


class SensorChain(nn.Module):
    """Parts in the order in which light meets them. An empty chain is absent: it returns the very tensor it was given.

    Args:
        parts: name -> part, or None for a part that is absent.
    """

    def __init__(self, parts: Mapping[str, SensorPart | None] | None = None) -> None:
        super().__init__()
        self.parts = nn.ModuleDict({name: part for name, part in (parts or {}).items() if part is not None})

    def prepare(self, scene: SceneData, modality: str = "thermal") -> None:
        for part in self.parts.values():
            part.prepare(scene, modality)

    @property
    def needs_depth(self) -> bool:
        """Whether a part needs to know how far away what is seen is."""
        return any(part.needs_depth for part in self.parts.values())

    def forward(self, image: Tensor, frame: Frame, depth: Tensor | None = None) -> Tensor:
        """The recorded image [H, W, C] of a clean one.

        Args:
            depth: [H, W] of what is seen (camera z), infinite where nothing is; where ``needs_depth``.

        Raises:
            ValueError: a part returned no image of as many channels.
        """
        for part in self.parts.values():
            seen = part(image, frame, depth) if part.needs_depth else part(image, frame)
            if not (isinstance(seen, Tensor) and seen.ndim == 3 and seen.shape[2] == image.shape[2]):
                told = (
                    f"a tensor of shape {list(seen.shape)}"
                    if isinstance(seen, Tensor)
                    else f"of type {type(seen).__name__}"
                )
                raise ValueError(
                    f"what sensor part {type(part).__name__} returned is {told}; it must be an image [H, W, {image.shape[2]}]"
                )
            image = seen
        return image

    def regularisers(self) -> dict[str, Tensor]:
        """Regularisers of the parts by name, absent ones left out."""
        terms = {name: part.regulariser() for name, part in self.parts.items()}
        return {name: term for name, term in terms.items() if term is not None}

    def effects(self) -> dict[str, dict[str, Any]]:
        """The effects that the parts simulate: catalogue name -> settings."""
        return {name: settings for part in self.parts.values() for name, settings in part.effects().items()}


class Composite(nn.Module):
    """Blends image values as they are, which are linear in temperature, as the papers do: nothing is computed.

    A detector adds what it receives. Where a pixel is half a cold and half a warm surface, it records the mean radiance,
    whose temperature lies above the mean temperature. A variant carries values over to a quantity that does add up, and
    what is blended back; the renderer sees the former.
    """

    def prepare(self, scene: SceneData, modality: str) -> None:
        """Takes what it needs from a scene. Called once, before anything else."""
        return

    def encode(self, values: Tensor, channels: int) -> Tensor:
        """What is blended of image values [..., C], of which the first ``channels`` are the thermal image's."""
        return values

    def decode(self, blended: Tensor, channels: int) -> Tensor:
        """The image values of what was blended, [..., C]."""
        return blended


def nonnegative_tanh(raw: Tensor) -> Tensor:
    """max(0, tanh(raw)) of any shape, with the slope of tanh below zero too: what has come to 0 can leave it again."""
    bounded = raw.tanh()
    return bounded + (bounded.clamp(min=0.0) - bounded).detach()
