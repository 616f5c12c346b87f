"""The one way to build a thermal model out of others: what it does not change is theirs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any

import torch
from torch import Tensor, nn

from heatsplat.contracts import Course, SceneData
from heatsplat.splats import GAUSSIANS, Splats
from heatsplat.thermal.base import NORMALS, Geometry, Heat, PerGaussian, Query, Rate, Seeds, ThermalModel


class Wrapper(ThermalModel):
    """A thermal model around its members: models and parts that are its attributes, or in a ModuleDict among them.

    Every hook asks all members; a subclass overrides what it changes, calls ``super()`` for the rest, and mostly overrides
    ``changed`` alone. The first model is the one that is wrapped: its images come first, geometry and temperature are
    its own. Further models are companions, whose images come after.

    Args:
        members: name of the attribute -> model or part, or a ModuleDict of them; None leaves it away.
        needs: metadata that the wrapper needs beside what its members do.
        own_channels: channels of a thermal image of the wrapper's own, before those of its members.

    Class attributes:
        own_beyond_record: what the wrapper itself assumes beyond the record, after what is wrapped and the parts.
    """

    own_beyond_record: str = ""

    def __init__(
        self, members: Mapping[str, nn.Module | None], needs: Iterable[str] = (), own_channels: int = 0
    ) -> None:
        super().__init__()
        for name, member in members.items():
            setattr(self, name, member)
        self.own_channels = own_channels
        every, models = self.members.values(), self._models
        for model in models:
            if model.rows != GAUSSIANS:
                raise ValueError(
                    f"{type(self).__name__} changes what Gaussians emit, and those of {type(model).__name__} are made anew for "
                    "every view, or there are none: choose another model to put into it, such as static"
                )
        self.needs = frozenset(needs).union(*(member.needs for member in every))
        self.optional = frozenset().union(*(member.optional for member in every))
        self.narrowest_range_k = max(self.narrowest_range_k, *(member.narrowest_range_k for member in every))
        self.inseparable = self.inseparable or next(filter(None, (member.inseparable for member in every)), "")
        self.stays_here = next(filter(None, (model.stays_here for model in models)), "")
        self.shared_opacity = models[0].shared_opacity
        self.start_opacity, self.averaged = models[0].start_opacity, models[0].averaged
        explained = [(name, count) for model in models for name, count in model.images]
        if own_channels:
            explained.insert(0, ("thermal", own_channels))
        (self.modality, *companions), self.modality_channels = zip(*explained, strict=True)
        self.companions = tuple(companions)

    @property
    def members(self) -> dict[str, Heat]:
        """Models and parts under the prefixes of their parameters."""
        found = {}
        for name, child in self.named_children():
            inner = (
                {name: child} if isinstance(child, Heat) else {f"{name}.{key}": m for key, m in child.named_children()}
            )
            found |= {prefix: member for prefix, member in inner.items() if isinstance(member, Heat)}
        return found

    @property
    def _models(self) -> list[ThermalModel]:
        return [member for member in self.members.values() if isinstance(member, ThermalModel)]

    def changed(self, values: Tensor, splats: Splats, query: Query) -> Tensor:
        """What becomes of the image's values [n, C] of the Gaussians in ``query.ids``; companions stay as they are."""
        return values

    # What the contract asks -----------------------------------------------------------------------------

    def check(self, scene: SceneData) -> None:
        for member in self.members.values():
            member.check(scene)
        super().check(scene)

    def prepare(self, scene: SceneData) -> None:
        for member in self.members.values():
            member.prepare(scene)

    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        """Those of all members, each of which sees the seed values of its own images.

        Raises:
            ValueError: two members have tensors of the same name.
        """
        tensors: list[dict[str, PerGaussian]] = []
        channel = self.own_channels
        for member in self.members.values():
            own = seeds
            if isinstance(member, ThermalModel):
                last = channel + sum(member.modality_channels)
                own, channel = seeds.of(channel, last), last
            tensors.append(member.per_gaussian(own))
        remedy = "give one a prefix, such as thermal.companion.prefix=companion_"
        return self._distinct(tensors, "a tensor", remedy, shared={NORMALS})

    def features(self, splats: Splats, query: Query) -> Tensor:
        image, *others = (model.features(splats, query) for model in self._models)
        channels = self.modality_channels[0]
        if image.shape[1] > channels:
            image, further = image[:, :channels], image[:, channels:]
            others = [further, *others]
        image = self.changed(image, splats, query)
        return torch.cat((image, *others), dim=1) if others else image

    def geometry(self, splats: Splats, query: Query) -> Geometry | None:
        return self._models[0].geometry(splats, query)

    def temperature(self, splats: Splats, time_s: float, ids: Tensor | None = None) -> Tensor | None:
        """That of what is wrapped: what a camera would see without anything in between."""
        return self._models[0].temperature(splats, time_s, ids)

    def temperatures(self, splats: Splats, times_s: Sequence[float], ids: Tensor | None = None) -> Tensor:
        if type(self).temperature is not Wrapper.temperature:  # it changes that of what is wrapped, time by time
            return super().temperatures(splats, times_s, ids)
        return self._models[0].temperatures(splats, times_s, ids)

    @property
    def removable(self) -> tuple[str, ...]:
        """Those of what is wrapped."""
        return self._models[0].removable

    @contextmanager
    def without(self, name: str) -> Iterator[None]:
        with self._models[0].without(name):
            yield

    @property
    def beyond_record(self) -> str:
        """What is assumed by the model that is wrapped, by the parts and by the wrapper; companions are left out."""
        parts = (member for member in self.members.values() if not isinstance(member, ThermalModel))
        clauses = [self._models[0].beyond_record, *(part.beyond_record for part in parts), self.own_beyond_record]
        return "; ".join(clause for clause in clauses if clause)

    def on_step(self, step: int) -> None:
        for member in self.members.values():
            member.on_step(step)

    def on_rows_changed(self) -> None:
        for member in self.members.values():
            member.on_rows_changed()

    def regularisers(self, splats: Splats) -> dict[str, Tensor]:
        """Those of all members.

        Raises:
            ValueError: two members have terms of the same name, of which one would be lost.
        """
        terms = [member.regularisers(splats) for member in self.members.values()]
        return self._distinct(terms, "a loss term", "give one another name")

    def rows_to_drop(self, splats: Splats, step: int) -> Iterator[tuple[str, Tensor, Mapping[str, Tensor]]]:
        for member in self.members.values():
            yield from member.rows_to_drop(splats, step)

    def attributes(self, splats: Splats, query: Query) -> dict[str, Tensor]:
        return _merged(member.attributes(splats, query) for member in self.members.values())

    def courses(self) -> list[Course]:
        return [course for member in self.members.values() for course in member.courses()]

    def quotients(self, told: Mapping[str, Tensor]) -> dict[str, Tensor]:
        return _merged(member.quotients(told) for member in self.members.values())

    def prior(self, splats: Splats) -> dict[str, Tensor]:
        return _merged(member.prior(splats) for member in self.members.values())

    def doubts(self) -> dict[str, Callable[[], AbstractContextManager[None]]]:
        return _merged(member.doubts() for member in self.members.values())

    def rate_of(self, name: str) -> Rate:
        """Of the member whose parameter it is, else the wrapper's own."""
        for prefix, member in self.members.items():
            if name.startswith(f"{prefix}."):
                return member.rate_of(name.removeprefix(f"{prefix}."))
        return super().rate_of(name)

    def effects(self) -> dict[str, dict[str, Any]]:
        return _merged(member.effects() for member in self.members.values())

    @property
    def cost(self) -> int:
        return sum(member.cost for member in self.members.values())

    def _distinct(
        self, parts: Sequence[dict[str, Any]], what: str, remedy: str, shared: Collection[str] = ()
    ) -> dict[str, Any]:
        """What all members have. Raises ValueError where two have something of one name, of which one would be lost."""
        times = Counter(name for part in parts for name in part)
        if twice := sorted(name for name, count in times.items() if count > 1 and name not in shared):
            raise ValueError(f"two members of {type(self).__name__} call {what} {', '.join(twice)}: {remedy}")
        return _merged(parts)


def _merged(parts: Iterable[dict[str, Any]]) -> dict[str, Any]:
    return {name: value for part in parts for name, value in part.items()}
