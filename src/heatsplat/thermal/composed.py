"""Exactly the effects that are wanted: a state of the surface, and the parts that its heat meets on the way to the lens."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from torch import Tensor, nn

from heatsplat.contracts import check_option
from heatsplat.splats import Splats
from heatsplat.thermal.base import Query, ThermalModel
from heatsplat.thermal.clipping import CLIPS, clipped
from heatsplat.thermal.part import HeatPart
from heatsplat.thermal.wrapper import Wrapper


class Composed(Wrapper):
    """A state model, the parts that change what it emits, and a companion with an opacity of its own.

    What is absent costs nothing: no parameter, no buffer, no operation. Without parts and companion the emission is the
    very tensor of the state. With parts, the state must not clip its values (``clip``), because what leaves the range of
    the image may come back into it on its way; they are clipped at the end.

    Args:
        state: temperatures of the surface in image units, such as ``Static`` or ``NewtonHarmonic``; one channel.
        parts: name -> part in the order in which heat meets them, or None for a part that is absent.
        companion: model of another image, such as ``Static`` of modality "rgb" with a ``prefix`` that keeps their tensors
            apart; Gaussians then have an opacity for each image. None for thermal images alone.
        clip: how values outside the image's range are shown after the parts: "straight_through", "hard" or "none".

    Raises:
        ValueError: an option is unknown, or the state does not explain one thermal channel.
    """

    def __init__(
        self,
        state: ThermalModel,
        parts: Mapping[str, HeatPart | None] | None = None,
        companion: ThermalModel | None = None,
        clip: str = "straight_through",
    ) -> None:
        check_option("clip", clip, CLIPS)
        if state.modality_channels != (1,):
            raise ValueError(f"the state must explain one channel, got {state.modality_channels}")
        present = {name: part for name, part in (parts or {}).items() if part is not None}
        super().__init__({"state": state, "parts": nn.ModuleDict(present), "companion": companion})
        self.shared_opacity = companion is None  # a state of one image says nothing of whether two share theirs
        self.clip = clip

    def changed(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        for part in self.parts.values():
            values = part(values, splats, query)
        return clipped(values, self.clip) if self.parts else values

    @property
    def removable(self) -> tuple[str, ...]:
        return tuple(self.parts)

    @contextmanager
    def without(self, name: str) -> Iterator[None]:
        whole = self.parts
        self.parts = nn.ModuleDict({key: part for key, part in whole.items() if key != name})
        try:
            yield
        finally:
            self.parts = whole

    def effects(self) -> dict[str, dict[str, Any]]:
        """Those of state and parts; of a companion, that it has an opacity of its own."""
        effects = dict(self.state.effects())
        for part in self.parts.values():
            effects |= part.effects()
        if self.companion is not None:
            effects["thermal_opacity"] = {"opacities": len(self.opacity_channels)}
        return effects
