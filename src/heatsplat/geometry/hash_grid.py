"""Features at places in space from grids of several sizes whose nodes share a table (Müller et al., SIGGRAPH 2022)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

# π_2 and π_3 of Eq. 4 as int32; products and the exclusive or wrap around as those of uint32 do.
PRIMES = (1, 2654435761 - 2**32, 805459861)


def sizes(levels: int, coarsest: int, finest: int) -> list[int]:
    """Cells along an axis at each level, from coarsest to finest in equal factors (Eq. 2-3), rounded down."""
    if levels == 1:
        return [coarsest]
    factor = (finest / coarsest) ** (1 / (levels - 1))
    return [int(coarsest * factor**level + 1e-6) for level in range(levels)]


def interpolated(tables: Tensor, cells: Sequence[int], places: Tensor) -> Tensor:
    """Trilinear interpolation between the nodes of all grids, side by side: [n, L F]; differentiable in the tables.

    **Convention:** places lie in [0, 1]³ and a grid of N cells has N + 1 nodes along an axis. A grid whose nodes have room in
    a table has one entry for each; of others the nodes share entries as ``PRIMES`` say, x ⊕ π_2 y ⊕ π_3 z mod T.

    Args:
        tables: [L, T, F]; T a power of two.
        cells: N of each of the L grids.
        places: [n, 3].
    """
    entries, found = tables.shape[1], []
    axes = places.T.contiguous()
    for table, count in zip(tables.unbind(0), cells, strict=True):
        scaled = axes * count
        below = scaled.floor().clamp(0, count - 1)
        above = scaled - below
        below = below.int()
        dense = (count + 1) ** 3 <= entries
        factors = (1, count + 1, (count + 1) ** 2) if dense else PRIMES
        x, y, z = (
            torch.stack((node * factor, (node + 1) * factor)) for node, factor in zip(below, factors, strict=True)
        )
        x, y = x[:, None, None], y[:, None]
        rows = x + y + z if dense else (x ^ y ^ z) & (entries - 1)
        u, v, w = (torch.stack((1 - share, share)) for share in above)
        weights = (u[:, None, None] * v[:, None] * w).flatten(0, 2)
        # The gradient of index_select adds up ten times faster by int64 than by int32.
        corners = table.index_select(0, rows.flatten().long()).view(8, -1, table.shape[1])
        found.append((corners * weights[..., None]).sum(0))
    return torch.cat(found, dim=1)
