"""Features at places in space from grids of several sizes whose nodes share a table (Müller et al., SIGGRAPH 2022)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from heatsplat.derivatives import once_differentiable
from heatsplat.kernels import hash_grid as kernel

# π_2 and π_3 of Eq. 4 as int32; products and the exclusive or wrap around as those of uint32 do.
PRIMES = (1, kernel.PRIME_Y - 2**32, kernel.PRIME_Z)


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

    On a CPU a kernel does it for two numbers of float32.

    Args:
        tables: [L, T, F]; T a power of two.
        cells: N of each of the L grids.
        places: [n, 3].
    """
    fits = places.device.type == "cpu" and tables.dtype == places.dtype == torch.float32 and tables.shape[2] == 2
    return _Interpolated.apply(tables, cells, places) if fits else interpolated_reference(tables, cells, places)


def interpolated_reference(tables: Tensor, cells: Sequence[int], places: Tensor) -> Tensor:
    """``interpolated`` in plain torch, on any device and in any precision."""
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


class _Interpolated(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, tables: Tensor, cells: Sequence[int], places: Tensor) -> Tensor:
        found = places.new_empty(len(places), 2 * len(tables))
        ctx.cells, ctx.shape = np.array(cells, np.int64), tables.shape
        ctx.save_for_backward(places)
        places = places.detach().contiguous().numpy()
        kernel.interpolate(tables.detach().contiguous().numpy(), ctx.cells, places, found.numpy())
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None]:
        (places,) = ctx.saved_tensors
        v_tables = grad.new_empty(ctx.shape)
        arrays = [tensor.detach().contiguous().numpy() for tensor in (places, grad)]
        kernel.differentiate(ctx.cells, *arrays, v_tables.numpy())
        return v_tables, None, None
