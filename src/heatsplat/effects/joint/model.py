"""A selection of effects for the joint fit."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass


@dataclass(frozen=True)
class Model:
    """Effects by name, each in one of its kinds (see ``Term.kinds``)."""

    effects: frozenset[tuple[str, object]] = frozenset()

    @classmethod
    def of(cls, **kinds: object) -> Model:
        """The model of these effects: ``Model.of(relaxation=1, attenuation="constant")``."""
        return cls(frozenset(kinds.items()))

    @property
    def names(self) -> frozenset[str]:
        """Of the effects in it."""
        return frozenset(name for name, _ in self.effects)

    def kind(self, name: str) -> object | None:
        """In which kind it has an effect; None where it lacks it."""
        return dict(self.effects).get(name)

    def plus(self, name: str, kind: object = 1) -> Model:
        """This model with an effect, in this kind instead of any other."""
        return Model(frozenset((dict(self.effects) | {name: kind}).items()))

    def minus(self, names: Collection[str]) -> Model:
        """This model without these effects."""
        return Model(frozenset((name, kind) for name, kind in self.effects if name not in names))
