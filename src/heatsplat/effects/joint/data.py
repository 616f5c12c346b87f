"""What the joint fit explains, and what is known beforehand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

from torch import Tensor

from heatsplat.effects.joint.model import Model
from heatsplat.effects.observations import Tracks

if TYPE_CHECKING:
    from heatsplat.effects.base import Effect

MIN_FREE = 4  # observations of a point that its own parameters must leave free


@dataclass(frozen=True)
class Data:
    """Tracks of P points in F frames, and what a scene says beside them.

    Args:
        effects: those with a term in the fit, by name, in the order of the catalogue.
        tracks: what is explained.
        times_s: [F] or None; without times nothing changes in time.
        ambient: image value of the surroundings, or None.
        noise: of a pixel, in image units.
        normals: [P, 3] of the surface at the points, or None.
        drivers: [F, k] how surfaces answer a weather record, which then stands for relaxation, or None.
        balances: [P, F, k] in which ways each point's own balance of heat goes under that record, in the place of ``drivers``
            where points follow such balances to within the errors expected of them, or None.
        balances_err: by how much these may err together in an image.
    """

    effects: Mapping[str, Effect]
    tracks: Tracks
    times_s: Tensor | None
    ambient: float | None
    noise: float
    normals: Tensor | None = None
    drivers: Tensor | None = None
    balances: Tensor | None = None
    balances_err: float = 0.0

    @property
    def rough(self) -> bool:
        """Whether a weather record says roughly how surfaces change, no better than any other answer to it would."""
        return self.drivers is not None and self.balances is None

    @property
    def frames(self) -> int:
        return self.tracks.values.shape[1]

    @cached_property
    def span_s(self) -> float:
        """Length of the record."""
        return 0.0 if self.times_s is None else float(self.times_s.max() - self.times_s.min())

    @property
    def passed(self) -> Tensor:
        """Times [F] as shares of the record."""
        return (self.times_s - self.times_s.min()) / self.span_s

    @cached_property
    def usual_length(self) -> float:
        """How many frames see a point, in the median."""
        return float(self.tracks.weights.sum(1).median())

    @cached_property
    def moves(self) -> bool:
        """Whether points are seen from several places, so that they move through the image."""
        return bool(self.tracks.directions.std(1).max() > 1e-6)

    @cached_property
    def rich(self) -> Model:
        """A model that follows most things; what it leaves tells good points from bad ones before anything is known."""
        kinds = {name: effect.term.rich(self) for name, effect in self.effects.items()}
        return Model.of(**{name: kind for name, kind in kinds.items() if kind is not None})
