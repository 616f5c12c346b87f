"""Exactly the effects that are wanted: a state of the surface, and the parts that its heat meets on the way to the lens."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import SceneData
from heatsplat.splats import Splats
from heatsplat.thermal.base import Emission, Geometry, PerGaussian, Query, Seeds, ThermalModel
from heatsplat.thermal.clipping import CLIPS, clipped
from heatsplat.thermal.part import HeatPart

COMPANION = "companion_"  # before the names of its tensors: a static state and a static companion have the same ones


class _OfCompanion:
    """Splats whose tensors are those of the companion, under the names that it gave them."""

    def __init__(self, splats: Splats) -> None:
        self._splats = splats

    def __getitem__(self, name: str) -> Tensor:
        return self._splats[COMPANION + name]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._splats, name)


class Composed(ThermalModel):
    """A state model, the parts that change what it emits, and a companion with an opacity of its own.

    What is absent costs nothing: no parameter, no buffer, no operation. Without parts and companion the emission is the
    very tensor of the state. With parts, the state must not clip its values (``clip``), because what leaves the range of
    the image may come back into it on its way; they are clipped at the end.

    Args:
        state: temperatures of the surface in image units, such as ``Static`` or ``NewtonHarmonic``; one channel.
        parts: name -> part in the order in which heat meets them, or None for a part that is absent.
        companion: model of another image, such as ``Static`` of modality "rgb"; Gaussians then have an opacity for each
            image. None for thermal images alone.
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
        super().__init__()
        if clip not in CLIPS:
            raise ValueError(f"clip must be one of {', '.join(CLIPS)}, got '{clip}'")
        if state.modality_channels != (1,):
            raise ValueError(f"the state must explain one channel, got {state.modality_channels}")
        self.state, self.clip = state, clip
        self.parts = nn.ModuleDict({name: part for name, part in (parts or {}).items() if part is not None})
        self.companion = companion
        self.modality = state.modality
        self.needs = frozenset().union(state.needs, *(part.needs for part in self.parts.values()))
        if companion is not None:
            self.needs |= companion.needs
            self.companions = (companion.modality,)
            self.modality_channels = (*state.modality_channels, *companion.modality_channels)

    def prepare(self, scene: SceneData) -> None:
        for owner in self._owners().values():
            owner.prepare(scene)

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        own = Seeds(seeds.means, seeds.values[:, :1], seeds.generator)
        tensors = self.state.per_gaussian(own)
        for part in self.parts.values():
            tensors |= part.per_gaussian(own)
        if self.companion is not None:
            others = self.companion.per_gaussian(Seeds(seeds.means, seeds.values[:, 1:], seeds.generator))
            tensors |= {COMPANION + name: tensor for name, tensor in others.items()}
        return tensors

    def features(self, splats: Splats, query: Query) -> Emission:
        emission = self.state.features(splats, query)
        if self.parts:
            values = emission.features
            for part in self.parts.values():
                values = part(values, splats, query)
            emission = Emission(clipped(values, self.clip))
        if self.companion is None:
            return emission
        others = self.companion.features(_OfCompanion(splats), query).features
        return Emission(torch.cat((emission.features, others), dim=1))

    def geometry(self, splats: Splats, query: Query) -> Geometry | None:
        return self.state.geometry(splats, query)

    def on_step(self, step: int) -> None:
        for owner in self._owners().values():
            owner.on_step(step)

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        terms = self.state.regularisers(splats)
        for part in self.parts.values():
            terms |= part.regularisers()
        return terms

    def needless_rows(self, splats: Splats, step: int) -> Iterable[tuple[str, Tensor, Mapping[str, Tensor]]]:
        return self.state.needless_rows(splats, step)

    def temperature(self, splats: Splats, time_s: float) -> Tensor | None:
        """That of the state: what a camera would see at the surface itself."""
        return self.state.temperature(splats, time_s)

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        found = self.state.attributes(splats, query)
        for part in self.parts.values():
            found |= part.attributes(splats, query)
        return found

    def rate_of(self, name: str) -> tuple[float, float]:
        """Of the owner of the parameter."""
        for prefix, owner in self._owners().items():
            if name.startswith(f"{prefix}."):
                inner = name.removeprefix(f"{prefix}.")
                return (owner.lr, owner.lr_end) if prefix.startswith("parts.") else owner.rate_of(inner)
        return self.lr, self.lr_end

    def effects(self) -> dict[str, dict]:
        effects = self.state.effects()
        for part in self.parts.values():
            effects |= part.effects()
        if self.companion is not None:
            effects["thermal_opacity"] = {"opacities": len(self.opacity_channels)}
        return effects

    @property
    def cost(self) -> int:
        return sum(owner.cost for owner in self._owners().values())

    def _owners(self) -> dict[str, ThermalModel | HeatPart]:
        """State, parts and companion under the prefixes of their parameters."""
        owners = {"state": self.state} | {f"parts.{name}": part for name, part in self.parts.items()}
        return owners if self.companion is None else owners | {"companion": self.companion}
