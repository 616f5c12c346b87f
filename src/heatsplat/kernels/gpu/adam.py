"""Adam over all tensors of a step in one launch, as heatsplat.kernels.adam has it, for CUDA.

torch launches twice and walks through its own checks for each tensor, of which a step of Gaussians has five to forty. Tensors
are told by address here, too. A program takes BLOCK numbers of one of them.
"""

from __future__ import annotations

import triton
import triton.language as tl

BLOCK = 1024  # numbers of a program

WIDTH = tl.constexpr(15)  # numbers of a row of ``tensors``


@triton.jit
def _at(line, column: tl.constexpr, k):
    """Pointer to number ``k`` from the address in a column."""
    return tl.load(line + column).to(tl.int64).to(tl.pointer_type(tl.float32)) + k


@triton.jit
def step(tensors, owners, BLOCK: tl.constexpr):
    """Steps all tensors.

    Args:
        tensors: [T, WIDTH] float64, whose digits suffice for an address; columns are named below: addresses of a tensor, its
            gradient, its moments and the norms of its columns (0 for none), the first program that works on it, its numbers and
            columns, and what Adam does to it.
        owners: [programs] int32, the row of each program's tensor.
    """
    # Here rather than global: Triton looks at every launch whether a global has changed.
    TENSOR: tl.constexpr = 0
    GRADIENT: tl.constexpr = 1
    FIRST: tl.constexpr = 2
    SECOND: tl.constexpr = 3
    NORMS: tl.constexpr = 4
    PROGRAM: tl.constexpr = 5
    COUNT: tl.constexpr = 6
    COLUMNS: tl.constexpr = 7
    STEP: tl.constexpr = 8
    KEPT_FIRST: tl.constexpr = 9
    KEPT_SECOND: tl.constexpr = 10
    INVERSE_ROOT: tl.constexpr = 11
    EPS: tl.constexpr = 12
    DECAY: tl.constexpr = 13
    PENALTY: tl.constexpr = 14
    program = tl.program_id(0)
    line = tensors + tl.load(owners + program) * WIDTH
    k = (program - tl.load(line + PROGRAM).to(tl.int64)) * BLOCK + tl.arange(0, BLOCK)
    inside = k < tl.load(line + COUNT).to(tl.int64)
    x = tl.load(_at(line, TENSOR, k), mask=inside, other=0.0)
    g = tl.load(_at(line, GRADIENT, k), mask=inside, other=0.0)
    m = tl.load(_at(line, FIRST, k), mask=inside, other=0.0)
    v = tl.load(_at(line, SECOND, k), mask=inside, other=0.0)
    decay = tl.zeros_like(x) + tl.load(line + DECAY).to(tl.float32)
    if tl.load(line + NORMS) != 0.0:
        column = k % tl.load(line + COLUMNS).to(tl.int64)
        norm = tl.load(_at(line, NORMS, column), mask=inside, other=0.0)
        pull = tl.load(line + PENALTY).to(tl.float32) / tl.where(norm > 0.0, norm, 1.0)
        decay += tl.where(norm > 0.0, pull, 0.0)
    g += decay * x
    kept = tl.load(line + KEPT_SECOND).to(tl.float32)
    m += (1.0 - tl.load(line + KEPT_FIRST)).to(tl.float32) * (g - m)
    v = kept * v + (1.0 - tl.load(line + KEPT_SECOND)).to(tl.float32) * g * g
    root = tl.sqrt_rn(v) * tl.load(line + INVERSE_ROOT).to(tl.float32) + tl.load(line + EPS).to(tl.float32)
    x -= tl.load(line + STEP).to(tl.float32) * m / root
    tl.store(_at(line, FIRST, k), m, mask=inside)
    tl.store(_at(line, SECOND, k), v, mask=inside)
    tl.store(_at(line, TENSOR, k), x, mask=inside)


def blocks(count: int) -> int:
    """How many programs a tensor of ``count`` numbers takes."""
    return -(-count // BLOCK)
