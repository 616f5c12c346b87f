"""What an effect is in the joint fit: its columns, and what it has to show to be taken in.

Tracks of scene points are explained as

    value(point, frame) = Σ own(point) · basis(point, frame) + Σ shared · column(point, frame) + noise.

A point's own part is a level and the bases of the ``Own`` effects; ``Shared`` effects have one set of numbers for all points;
a ``Path`` lets a share of a point's own part arrive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from torch import Tensor

from heatsplat.effects.joint.columns import Columns
from heatsplat.effects.joint.data import Data
from heatsplat.effects.joint.model import Model

if TYPE_CHECKING:
    from heatsplat.effects.joint.fit import Fit

# What an effect has to gain over the cost of its parameters. Points at edges look different from every place and hence at
# every time, which gives a point's own parameters up to 1.5 on scenes of which it is known that nothing changes.
# A pattern gets up to 1.7 on heated scenes, by how the courses of their points err.
OWN_HURDLE, SHARED_HURDLE = 2.5, 1.3
# An effect whose size is less than this share of the expected error is left out.
SMALLEST = 0.1
WELL_SEEN = 2.5  # observations of a point for each of its own numbers from which these can be told


def never(data: Data) -> object | None:
    """No kind of it."""
    return None


@dataclass(frozen=True, kw_only=True)
class Term:
    """What all kinds of terms have.

    Args:
        kinds: (Fit) -> the kinds in which it can be tried, the smallest first; none where the tracks cannot show it.
        numbers: (Data, kind) -> how many numbers it has beside those of single points.
        unseen: (Data) -> why there are no kinds, in words.
        rich: (Data) -> the kind in which it stands in the model by which good points are told from bad ones before
            anything is known; None where it does not.
        starts: (Data) -> models from which the selection starts, beside that of nothing.
        frames: (Data) -> in how many frames points must be seen for the fit to tell it at all.
        in_time: whether it makes the scene change.
        single_images: whether its numbers belong to single images.
        rivals: effects by name, one or several together, that look so much like it that it has to outdo them on held-out
            observations to be told.
        gives_way_to: effects of fewer numbers by name: it is not there where one of them makes do (``selection.makes_do``).
        told_by: rules that it has to meet to be told, beside those by which it is taken in, and what it is that does not meet
            them.
        sensor_first: whether one way of the selection tries it before the other effects.
        smallest: its size in expected errors below which it is left out.
        beside_changes: in a scene that changes, the share of its changes that its size must exceed.
        rules: (Fit, model with it, model without it) -> whether what it explains can be its own.
    """

    kinds: Callable[[Fit], Sequence[object]]
    numbers: Callable[[Data, object], int] = lambda data, kind: 0
    unseen: Callable[[Data], str] = lambda data: "points are seen from one side only"
    rich: Callable[[Data], object | None] = never
    starts: Callable[[Data], Sequence[Model]] = lambda data: ()
    frames: Callable[[Data], int] = lambda data: 0
    in_time: bool = False
    single_images: bool = False
    rivals: Sequence[tuple[str, ...]] = ()
    gives_way_to: Sequence[str] = ()
    told_by: Sequence[tuple[Callable[[Fit, Model, Model], bool], str]] = ()
    sensor_first: bool = False
    smallest: float = SMALLEST
    beside_changes: float = 0.0
    rules: Sequence[Callable[[Fit, Model, Model], bool]] = ()


@dataclass(frozen=True, kw_only=True)
class Own(Term):
    """An effect for which every point has numbers of its own.

    Args:
        basis: (Fit, kind) -> what they multiply, [F, k] or [P, F, k].
    """

    basis: Callable[[Fit, object], Tensor]


@dataclass(frozen=True, kw_only=True)
class Shared(Term):
    """An effect with one set of numbers for all points.

    Args:
        columns: (Data, image, known) -> what the numbers multiply, as ``Columns`` of P points in F images. ``image`` [P, F] is
            the points' own part with what earlier terms added; ``known`` [P, F] by name is what terms added when the fit was
            linearised.
        order: in which terms act on the image. What multiplies an image takes that with all earlier terms.
        settled: the numbers without the part that only renames the scene's own levels and their scale, which otherwise
            wander off from one linearisation to the next.
        gain: whether its numbers are gains, whose mean multiplies what earlier terms added.
    """

    columns: Callable[[Data, Tensor, Mapping[str, Tensor]], Columns]
    order: int
    settled: Callable[[Tensor], Tensor] = lambda numbers: numbers
    gain: bool = False


@dataclass(frozen=True, kw_only=True)
class Path(Term):
    """An effect between surface and camera.

    Args:
        passing: (Fit, kind, excess [P, F] over the surroundings without other paths, basis [P, F, k], weights [P, F]) -> the
            share [P, F] of the excess that arrives.
    """

    passing: Callable[[Fit, object, Tensor, Tensor, Tensor], Tensor]


def well_seen(numbers: int) -> int:
    """Frames in which a point must be seen for so many numbers of its own to be told."""
    return math.ceil(WELL_SEEN * numbers)


def centred(numbers: Tensor) -> Tensor:
    """Numbers without their mean."""
    return numbers - numbers.mean()


def where_moving(fit: Fit) -> Sequence[object]:
    """One kind where points are seen from several places. Nobody tells the pattern of a camera that stands still from the
    scene."""
    return (1,) if fit.data.moves else ()
