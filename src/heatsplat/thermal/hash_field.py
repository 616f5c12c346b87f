"""A field on hash grids: instant-ngp of one image, ThermoNeRF of a thermal and a visible one that share the density."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import torch
from torch import Tensor, nn

from heatsplat.geometry import hash_grid, spherical_harmonics
from heatsplat.geometry.volume import contracted
from heatsplat.same_bits import sigmoid
from heatsplat.thermal.base import PerGaussian, Query, Seeds
from heatsplat.thermal.field import Field
from heatsplat.thermal.layers import draw_uniform

DEGREE = 3  # of the harmonics of the direction (instant-ngp: 16 of them)
LARGEST_LOG = 12.0  # of a density per half edge: what is denser lets e^-160000 of the light through a thousandth of it
START = 1e-4  # entries of the tables before training lie within (Müller et al. 2022)


class HashField(Field):
    """Density exp(h_0 - 1) and values of heads, with h a network's answer to the features of hash grids at a place.

    All space is contracted into the grids (``geometry.volume.contracted``). Each image has a head of one hidden layer and a
    sigmoid; those in ``directional`` see the direction of view too, as harmonics. Gradients of all images reach the density.

    Where it departs from public code: ThermoNeRF's has networks of 64 units, 16 levels, networks of its own that propose
    samples with losses for them (interlevel, distortion), codes of images and cameras that train; instant-ngp's has an
    occupancy grid. Here the field proposes samples to itself, the renderer's coarse pass, and sizes are for a processor.

    Args:
        channels: of the image; 1 for thermal images.
        modality: "thermal" or "rgb".
        companions: further images of the same density, modality -> channels, such as {"rgb": 3}.
        directional: images whose heads see the direction; heat is emitted almost evenly, and ThermoNeRF's does not.
        levels, coarsest, finest: grids, and cells along an axis of the first and the last one.
        entries_log2: logarithm to base two of the entries in the table of a grid.
        numbers: F, per entry.
        width: of the networks' hidden layers.
        known: numbers that the heads see of a place.
        lr, lr_end: learning rate of tables and networks, and the factor on it at the end of the run.

    Raises:
        ValueError: a size is not positive, or an image in ``directional`` is not explained.
    """

    def __init__(
        self,
        channels: int = 1,
        modality: str = "thermal",
        companions: Mapping[str, int] | None = None,
        directional: Collection[str] = (),
        levels: int = 8,
        coarsest: int = 16,
        finest: int = 512,
        entries_log2: int = 15,
        numbers: int = 2,
        width: int = 32,
        known: int = 15,
        lr: float = 1e-2,
        lr_end: float = 0.1,
    ) -> None:
        super().__init__()
        if min(channels, levels, coarsest, entries_log2, numbers, width, known) < 1 or finest < coarsest:
            raise ValueError(
                "thermal.channels, levels, coarsest, entries_log2, numbers, width and known must be at least 1 and finest not "
                f"below coarsest, got {channels}, {levels}, {coarsest}, {entries_log2}, {numbers}, {width}, {known}, {finest}"
            )
        images = {modality: channels, **(companions or {})}
        if unknown := sorted(set(directional) - set(images)):
            raise ValueError(f"thermal.directional names {', '.join(unknown)}; there are {', '.join(images)}")
        self.modality, *companions = images
        self.companions, self.modality_channels = tuple(companions), tuple(images.values())
        self.directional, self.lr, self.lr_end = frozenset(directional), lr, lr_end
        self.cells = hash_grid.sizes(levels, coarsest, finest)
        self.tables = nn.Parameter(torch.zeros(levels, 2**entries_log2, numbers))
        self.trunk = _network(levels * numbers, width, 1 + known)
        seen = {name: known + (DEGREE + 1) ** 2 * (name in self.directional) for name in images}
        self.heads = nn.ModuleDict({name: _network(seen[name], width, count) for name, count in images.items()})

    @torch.no_grad()
    def per_gaussian(self, seeds: Seeds) -> dict[str, PerGaussian]:
        """None; draws tables and networks."""
        nn.init.uniform_(self.tables, -START, START, generator=seeds.generator)
        draw_uniform((net[i] for net in (self.trunk, *self.heads.values()) for i in (0, 2)), seeds.generator)
        return {}

    def inside(self, places: Tensor) -> tuple[Tensor, Tensor]:
        found = self.trunk(hash_grid.interpolated(self.tables, self.cells, contracted(places) / 4 + 0.5))
        return (found[:, 0] - 1).clamp(max=LARGEST_LOG).exp(), found[:, 1:]

    def values(self, known: Tensor, directions: Tensor, query: Query) -> Tensor:
        seen = known
        if self.directional:
            seen = torch.cat((known, spherical_harmonics.basis(directions, DEGREE).to(known)), dim=1)
        answers = [sigmoid(head(seen if name in self.directional else known)) for name, head in self.heads.items()]
        return torch.cat(answers, dim=1) if len(answers) > 1 else answers[0]

    @property
    def cost(self) -> int:
        """Multiply-adds at a place."""
        networks = sum(net[i].weight.numel() for net in (self.trunk, *self.heads.values()) for i in (0, 2))
        return networks + 8 * self.tables.shape[0] * self.tables.shape[2]


def _network(inputs: int, width: int, outputs: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.ReLU(), nn.Linear(width, outputs))
