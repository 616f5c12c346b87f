"""TI-3DGS's density control: Gaussians with distant neighbours get company along the edges to them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from heatsplat.contracts import quantile
from heatsplat.density.adaptive import Adaptive
from heatsplat.density.base import DensityChange
from heatsplat.density.ops import Cloud
from heatsplat.geometry.neighbours import proximity_graph

EVEN = 1e-4  # scores that differ by less than this share are equal: an even cloud has no gaps but those of rounding


class Proximity(Adaptive):
    """Adaptive density control with thermal attenuation-aware insertions (TADC; TI-3DGS, section III-C 2, Eq. 13-14).

    Duplicating, splitting and pruning are as ever. In addition, every so often, the proximity graph of all centres is built
    anew: each Gaussian points to its K nearest others, and its score is the mean length of these edges. Where the score is
    above the threshold, a Gaussian is put on every edge: a copy of its source whose radiance is weaker by e^{-μ Δd}, Δd being
    its distance to the source. An edge that two sources share is used once, by the one with the higher score.

    Radiance is whatever the raw tensors named in ``radiance`` hold, up to an offset: the tensor plus its offset is
    multiplied. With the offset of a constant part (1/2 of 3DGS's emission is √π on "sh0") radiance itself is weakened;
    offsets of 0 scale the coefficients, as the paper prints.

    Args:
        radiance: name of a raw tensor -> offset. Names that the Gaussians do not have are skipped (harmonics of higher
            degree are optional), but not all of them.
        neighbours: K.
        quantile: share of the Gaussians whose score is not above the threshold; used without ``threshold``.
        threshold: t_prox in extents of the scene (paper: a number it does not give), or None.
        edge_share: Δd as a share of the edge; used without ``distance``.
        distance: Δd in extents (paper: a number it does not give), never beyond the end of the edge; or None.
        attenuation: μ per extent.
        min_opacity: sources must be at least this opaque, in some modality.
        insert_stop: last step at which Gaussians are inserted; the first is ``start``.
        insert_every: steps between insertions.
        insert_growth: one insertion adds at most this share of the Gaussians there are, and never more than fit under
            ``cap_max``; the highest scores come first.
        adaptive: the options of ``Adaptive``.

    Raises:
        ValueError: an option is out of its range.
    """

    milestones, intervals = (*Adaptive.milestones, "insert_stop"), (*Adaptive.intervals, "insert_every")

    def __init__(
        self,
        radiance: Mapping[str, float],
        neighbours: int = 3,
        quantile: float = 0.9,
        threshold: float | None = None,
        edge_share: float = 0.5,
        distance: float | None = None,
        attenuation: float = 0.1,
        min_opacity: float = 0.05,
        insert_stop: int = 7500,
        insert_every: int = 500,
        insert_growth: float = 0.05,
        **adaptive: Any,
    ) -> None:
        super().__init__(**adaptive)
        if neighbours < 1 or insert_every < 1:
            raise ValueError(
                f"density.neighbours and insert_every must be at least 1, got {neighbours}, {insert_every}"
            )
        if not 0 <= quantile <= 1 or not 0 < edge_share < 1:
            raise ValueError(f"density.quantile lies in [0, 1] and edge_share in (0, 1), got {quantile}, {edge_share}")
        given = [number for number in (threshold, distance) if number is not None]
        if min(attenuation, min_opacity, insert_stop, insert_growth, *given) < 0:
            raise ValueError(
                "density.attenuation, min_opacity, insert_stop, insert_growth, threshold and distance must not be negative, got "
                f"{attenuation}, {min_opacity}, {insert_stop}, {insert_growth}, {threshold} and {distance}"
            )
        if not radiance:
            raise ValueError(
                "density.radiance names no tensor; give those that hold radiance, such as {sh0: 1.7724539}"
            )
        self.radiance = dict(radiance)
        self.neighbours, self.quantile, self.threshold = neighbours, quantile, threshold
        self.edge_share, self.distance, self.attenuation = edge_share, distance, attenuation
        self.min_opacity, self.insert_growth = min_opacity, insert_growth
        self.insert_stop, self.insert_every = insert_stop, insert_every

    @torch.no_grad()
    def refine(self, cloud: Cloud, step: int, extent: float, generator: torch.Generator) -> DensityChange | None:
        change = super().refine(cloud, step, extent, generator)
        if not self.start <= step < self.insert_stop or not self._comes("insert_every", step):
            return change
        added = self._insert(cloud, extent)
        if added == 0:
            return change
        change = change or DensityChange()
        return DensityChange(change.added + added, change.removed, change.opacity_reset)

    def _insert(self, cloud: Cloud, extent: float) -> int:
        radiance = {name: offset for name, offset in self.radiance.items() if name in cloud.splats}
        if not radiance:
            raise ValueError(
                f"density.radiance names {', '.join(self.radiance)}, but the Gaussians have "
                f"{', '.join(cloud.splats.names)}; name the tensors that hold the radiance of this thermal model"
            )
        room = min(int(self.insert_growth * len(cloud)), self._room(cloud))
        if room < 1:
            return 0
        sources, lengths, ends = self._edges(cloud, extent, room)
        if self.distance is None:
            steps = self.edge_share * lengths
        else:
            steps = (self.distance * extent * torch.ones_like(lengths)).minimum(lengths)
        means = cloud.splats.means.detach()
        rows = cloud.rows(sources)
        rows["means"] = torch.lerp(means[sources], means[ends], (steps / lengths)[:, None])
        weaker = torch.exp(-self.attenuation * steps / extent)
        for name, offset in radiance.items():
            factor = weaker.reshape(-1, *[1] * (rows[name].ndim - 1))
            rows[name] = (rows[name] + offset) * factor - offset
        cloud.append(rows)
        return len(sources)

    def _edges(self, cloud: Cloud, extent: float, most: int) -> tuple[Tensor, Tensor, Tensor]:
        """Sources, lengths and ends of the edges to be populated, [n] each, n <= most; the highest scores first."""
        lengths, ends = proximity_graph(cloud.splats.means.detach(), self.neighbours)
        scores = lengths.mean(1) if lengths.shape[1] else lengths.new_zeros(len(lengths))
        limit = quantile(scores, self.quantile) if self.threshold is None else self.threshold * extent
        able = (cloud.splats.opacities >= self.min_opacity).any(dim=0) & (scores > (1.0 + EVEN) * limit)
        order = scores.argsort(descending=True, stable=True)
        order = order[able[order]]
        sources = order.repeat_interleave(ends.shape[1])
        lengths, ends = lengths[order].flatten(), ends[order].flatten()
        fresh = _first_of_each(torch.minimum(sources, ends) * len(cloud) + torch.maximum(sources, ends))
        fresh = fresh[lengths[fresh] > 0][:most]  # coinciding Gaussians have no room between them
        return sources[fresh], lengths[fresh], ends[fresh]


def _first_of_each(keys: Tensor) -> Tensor:
    """Positions of the first occurrence of every value, ascending."""
    _, inverse = keys.unique(return_inverse=True)
    positions = torch.arange(len(keys), device=keys.device)
    first = torch.full_like(keys, len(keys)).scatter_reduce(0, inverse, positions, "amin")
    return first[first < len(keys)].sort().values
