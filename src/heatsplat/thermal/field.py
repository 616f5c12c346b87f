"""Models without Gaussians: what each place in space absorbs and sends, of which a ray gathers an image."""

from __future__ import annotations

from abc import abstractmethod

import torch
from torch import Tensor

from heatsplat.contracts import SceneData
from heatsplat.splats import NOTHING, Splats
from heatsplat.thermal.base import Query, ThermalModel
from heatsplat.thermal.coordinates import FIELD_BOX


class Field(ThermalModel):
    """A density and image values at every place (NeRF); the renderer ``renderers.volume`` makes images of them.

    Subclasses give ``inside`` and ``values``. The scene's box is a cube of 1.2 times the longest edge of the central 98 % of
    its points; places are told to subclasses in its half edges from its middle, densities are one over a half edge.

    Attributes:
        span: world units; the box ends so far from a typical camera, and samples along rays lie evenly up to there.
    """

    rows = NOTHING
    inseparable = stays_here = "it has no Gaussians"
    shared_opacity = True
    beyond_record = "every place emits what it emits at all times"

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("center", torch.zeros(3))
        self.register_buffer("reach", torch.ones(()))  # half edge of the box, world units
        self.register_buffer("span_units", torch.ones(()))

    def prepare(self, scene: SceneData) -> None:
        center, edge = scene.bulk
        self.center.copy_(center)
        self.reach.fill_(FIELD_BOX * edge / 2)
        away = torch.stack([(frame.camera.center - center).norm() for frame in scene.train.frames]).median()
        self.span_units.fill_(float(away) + float(self.reach))

    @property
    def span(self) -> float:
        return float(self.span_units)

    def density(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """One over world units [n] at world points [n, 3], and what ``values`` wants to know of these places beside it."""
        density, known = self.inside((points - self.center) / self.reach)
        return density / self.reach, known

    @abstractmethod
    def inside(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Densities [n], one over a half edge, and whatever is known [n, ...] at places [n, 3] in half edges of the box."""

    @abstractmethod
    def values(self, known: Tensor, directions: Tensor, query: Query) -> Tensor:
        """Image values [n, C] sent against unit directions [n, 3] of lines of sight, of places of which this is known."""

    def features(self, splats: Splats, query: Query) -> Tensor:
        raise TypeError(f"{type(self).__name__} has no Gaussians that would emit; its renderer is renderers.volume")
