"""Responses of oriented surfaces to the sun's beam: to max(n · s, 0), which no product of tables separates.

The light on a surface is taken at the samples of the record, max(n · beam_k, 0), and is linear between them; a shaded
surface and the night are exactly zero. The last 12 to 24 hours are summed sample by sample with the surface's own normal and
rate (heatsplat.kernels.sunlight). What came before only decides where that sum starts: it is tabulated every 12 hours on
a grid of normals and rates, on which twelve hours later hardly anything sharp is left. So a surface costs the same in any record.

**Error:** the sum is exact. Of a beam that would heat by 60 K the tables miss 0.2 mK (root mean square), 2 mK in one of a
thousand cases, and 10 mK at worst: heavy surfaces that the sun grazes for hours (measured over three days of clouds).

**Convention:** beams [T, 3] are direction towards the sun times strength; normals are unit vectors in the same axes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from heatsplat.derivatives import once_differentiable
from heatsplat.kernels import sunlight as kernels
from heatsplat.physics.responses import cubics, driver_means, grid_position, interval_of, log_rate_grid, step_weights

ANCHOR_S = 12 * 3600.0  # between two tables of what came before
YOUNGEST_S = 12 * 3600.0  # age of the table that is used, at least (6 hours double its error)
HEIGHTS, AZIMUTHS = 91, 181  # of the grid of normals: 2 degrees (3 double the error); 3 MB for each table
FASTEST = 5e-4  # 1/s, the largest rate of the tables: twelve hours later 4e-10 is left of them
RATES = 49


class Seen(NamedTuple):
    """What n surfaces see of the sun.

    Args:
        shares: [n, D] in [0, 1] of the beam from D directions.
        directions: [D, 3].
        slots: [T] int64 direction at each sample of the record.
    """

    shares: Tensor
    directions: Tensor
    slots: Tensor

    def mean(self, normals: Tensor) -> Tensor:
        """Share [n] of the beam over all directions, by how it strikes."""
        weights = (normals @ self.directions.T.to(normals)).clamp(min=0.0)
        return ((weights * self.shares).sum(1) / weights.sum(1).clamp(min=1e-6)).to(normals)


class SunlightTable:
    """Settled responses of surfaces to a record of beams.

    Args:
        times_s: [T] float64, increasing.
        beams: [T, 3], any unit.
    """

    def __init__(self, times_s: Tensor, beams: Tensor) -> None:
        self.times_s, self.beams = times_s, beams.to(torch.float64).contiguous()
        self.steps = times_s.diff().contiguous()
        self.log_rates = log_rate_grid(RATES, highest=FASTEST)
        self._normals = _normals()
        lit = (self._normals @ self.beams.T).clamp(min=0.0)
        self._means = driver_means(times_s, lit.T).reshape(-1, 1).float()
        self._anchors, self._tables = self._tabulate(lit)

    def _tabulate(self, lit: Tensor) -> tuple[list[int], list[Tensor]]:
        """Samples at which there are tables, and the tables [heights, azimuths, A] at each but the first, where
        all is zero."""
        rates = self.log_rates.exp()
        state, start = lit.new_zeros(len(self.log_rates), len(lit)), 0
        anchors, tables = [0], []
        while True:
            end = int(torch.searchsorted(self.times_s, self.times_s[start] + ANCHOR_S))
            if end >= len(self.times_s) - 1:
                return anchors, tables
            decay, before, after = step_weights(rates[:, None], self.steps[start:end])
            ages = self.times_s[end] - self.times_s[start + 1 : end + 1]
            since = torch.exp(-rates[:, None] * ages)
            weights = torch.zeros(len(rates), end - start + 1, dtype=torch.float64)
            weights[:, :-1] += since * before
            weights[:, 1:] += since * after
            total = torch.exp(-rates * (self.times_s[end] - self.times_s[start]))
            state = total[:, None] * state + weights @ lit[:, start : end + 1].T
            tables.append(state.T.reshape(HEIGHTS, AZIMUTHS, -1).float())
            anchors.append(end)
            start = end

    def mean(self, normals: Tensor) -> Tensor:
        """Mean over the record of max(n · beam, 0), [n], for normals [n, 3]; interpolated between grid lines."""
        corners, weights = _corners(normals)
        return (self._means.to(weights)[corners, 0] * weights).sum(1)

    def response(self, time_s: float, normals: Tensor, log_rates: Tensor, seen: Seen | None = None) -> Tensor:
        """Settled responses [n] at a moment of the record; differentiable by normals [n, 3] and log rates [n].

        Of what is ``seen`` of the sun, the hours before those that are summed know the mean alone.
        """
        oldest = time_s - YOUNGEST_S
        anchor = max([0] + [a for a, k in enumerate(self._anchors) if float(self.times_s[k]) <= oldest])
        first = self._anchors[anchor]
        last, seconds = interval_of(self.times_s, time_s)
        share = seconds / float(self.steps[last])
        within = slice(first, last + 2)
        shares, slots = (normals.new_empty(len(normals), 0), torch.zeros(1, dtype=torch.int64))
        if seen is not None:
            shares, slots = seen.shares, seen.slots[within]
        steps = self.steps[first : last + 1]
        recent = _Recent.apply(normals, log_rates, steps, self.beams[within], shares, slots, share)
        if anchor == 0:
            return recent
        kept = torch.exp(-log_rates.exp() * (time_s - float(self.times_s[first])))
        if seen is not None:
            kept = kept * seen.mean(normals)
        return recent + kept * self._earlier(self._tables[anchor - 1], normals, log_rates)

    def _earlier(self, table: Tensor, normals: Tensor, log_rates: Tensor) -> Tensor:
        """Responses [n] at the moment of a table [heights, azimuths, rates]."""
        corners, weights = _corners(normals)
        cell, x = grid_position(log_rates, self.log_rates)
        places = (corners * RATES + cell[:, None])[..., None] + torch.arange(4, device=cell.device)
        values = (table.to(cell.device).reshape(-1)[places] * weights[..., None]).sum(1)
        terms = cubics(values.T)[0]
        return terms[0] + x * (terms[1] + x * (terms[2] + x * terms[3]))


def _normals() -> Tensor:
    """The grid of normals [M, 3], by height from the south pole and azimuth; the last azimuth repeats the first."""
    heights = torch.linspace(-math.pi / 2, math.pi / 2, HEIGHTS, dtype=torch.float64)
    azimuths = torch.linspace(-math.pi, math.pi, AZIMUTHS, dtype=torch.float64)
    height, azimuth = torch.meshgrid(heights, azimuths, indexing="ij")
    level = height.cos()
    return torch.stack((level * azimuth.cos(), level * azimuth.sin(), height.sin()), dim=-1).reshape(-1, 3)


def _corners(normals: Tensor) -> tuple[Tensor, Tensor]:
    """The four grid normals about each of normals [n, 3], [n, 4] int64, and their weights [n, 4]."""
    x, y, z = normals.unbind(1)
    level = (x * x + y * y + 1e-18).sqrt()  # not 0, where the root has no derivative
    row = (torch.atan2(z, level) / math.pi + 0.5) * (HEIGHTS - 1)
    column = (torch.atan2(y, x) / (2 * math.pi) + 0.5) * (AZIMUTHS - 1)
    i = row.detach().long().clamp(0, HEIGHTS - 2)
    j = column.detach().long().clamp(0, AZIMUTHS - 2)
    up, across = row - i, column - j
    first = i * AZIMUTHS + j
    corners = torch.stack((first, first + 1, first + AZIMUTHS, first + AZIMUTHS + 1), dim=1)
    weights = torch.stack(((1 - up) * (1 - across), (1 - up) * across, up * (1 - across), up * across), dim=1)
    return corners, weights


class _Recent(torch.autograd.Function):
    """Responses since a sample, from rest there; the kernel runs on the CPU and gives derivatives along with values."""

    @staticmethod
    def forward(
        ctx, normals: Tensor, log_rates: Tensor, steps: Tensor, beams: Tensor, seen: Tensor, slots: Tensor, share: float
    ) -> Tensor:
        on_cpu = normals.detach().cpu().contiguous(), log_rates.detach().cpu().contiguous()
        responses, slopes = (torch.empty(len(log_rates), dtype=log_rates.dtype) for _ in range(2))
        vectors = torch.empty(len(log_rates), 3, dtype=normals.dtype)
        kernels.recent_sunlight(
            on_cpu[0].numpy(),
            on_cpu[1].numpy(),
            steps.numpy(),
            beams.numpy(),
            seen.detach().cpu().contiguous().numpy(),
            slots.numpy(),
            share,
            *(x.numpy() for x in (responses, slopes, vectors)),
        )
        device = log_rates.device
        ctx.save_for_backward(slopes.to(device), vectors.to(device))
        return responses.to(device)

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor):
        slopes, vectors = ctx.saved_tensors
        return gradient[:, None] * vectors, gradient * slopes, None, None, None, None, None
