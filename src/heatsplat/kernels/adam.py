"""Adam over all tensors of a step at once: each number of a tensor, its gradient and its two moments are read once.

Plain twin: torch.optim.Adam. Tensors are told by address, so that one kernel serves any number of them, in one parallel
region. Decay may differ from column to column of a tensor, which is how penalties of groups come in.
"""

from __future__ import annotations

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

from heatsplat.kernels.compilation import inline, kernel
from heatsplat.kernels.scheduling import parallel_for
from heatsplat.kernels.simd import LANES, float32x16, load, load_columns, splat, sqrt, store_columns, total

SHARE = 8192  # numbers per task
SQUARED_ROWS = 512  # rows of a matrix per task of ``square_columns``

# Columns of a row of ``tensors``: addresses of the tensor, its gradient and its moments, how many numbers it has, the first
# task that works on it, where its decay begins in ``decays`` and after how many numbers it repeats, a multiple of LANES; of
# ``rates``: what Adam does to it.
TENSOR, GRADIENT, FIRST, SECOND, COUNT, TASK, DECAY, PERIOD = range(8)
STEP, KEPT_FIRST, KEPT_SECOND, INVERSE_ROOT, EPS = range(5)

_f32 = ir.FloatType()
_vector = ir.VectorType(_f32, LANES)


def _pointer(builder, address, offset):
    """Pointer to sixteen numbers at ``offset`` from an address."""
    return builder.bitcast(builder.gep(builder.inttoptr(address, _f32.as_pointer()), [offset]), _vector.as_pointer())


@intrinsic
def _load_at(typing_context, address, offset):
    """Sixteen float32 at ``offset`` from an address."""

    def generate(context, builder, signature, values):
        return builder.load(_pointer(builder, *values), align=4)

    return float32x16(types.int64, types.int64), generate


@intrinsic
def _store_at(typing_context, address, offset, value):
    """Writes sixteen float32 at ``offset`` from an address."""

    def generate(context, builder, signature, values):
        builder.store(values[2], _pointer(builder, *values[:2]), align=4)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, float32x16), generate


@intrinsic
def _copy(typing_context, target, source, count):
    """Copies ``count`` float32 from one address to another."""

    def generate(context, builder, signature, values):
        pointers = [builder.inttoptr(address, _f32.as_pointer()) for address in values[:2]]
        with cgutils.for_range(builder, values[2]) as loop:
            target, source = (builder.gep(pointer, [loop.index]) for pointer in pointers)
            builder.store(builder.load(source), target)
        return context.get_dummy_value()

    return types.void(types.int64, types.int64, types.int64), generate


@inline
def updated(x, g, m, v, decay, rates):
    """Sixteen numbers and their moments after a step with gradient ``g``; ``rates`` is a row as below."""
    g = g + decay * x
    m = m + (np.float32(1.0) - rates[KEPT_FIRST]) * (g - m)
    v = rates[KEPT_SECOND] * v + (np.float32(1.0) - rates[KEPT_SECOND]) * g * g
    return x - rates[STEP] * m / (sqrt(v) * rates[INVERSE_ROOT] + rates[EPS]), m, v


@inline
def _update(tensor, gradient, first, second, k, decay, rates):
    """Steps sixteen numbers, and returns them."""
    x, m, v = updated(_load_at(tensor, k), _load_at(gradient, k), _load_at(first, k), _load_at(second, k), decay, rates)
    _store_at(first, k, m)
    _store_at(second, k, v)
    _store_at(tensor, k, x)
    return x


@inline
def _share(task, tensors, rates, decays, sums):
    """A share of one tensor."""
    row = 0
    while row + 1 < tensors.shape[0] and tensors[row + 1, TASK] <= task:
        row += 1
    tensor, gradient = tensors[row, TENSOR], tensors[row, GRADIENT]
    first, second, count = tensors[row, FIRST], tensors[row, SECOND], tensors[row, COUNT]
    begin = (task - tensors[row, TASK]) * SHARE
    end = min(begin + SHARE, count)
    whole = begin + (end - begin) // LANES * LANES
    period, added = tensors[row, PERIOD], splat(0.0)
    phase = begin % period
    for k in range(begin, whole, LANES):
        decay = load(decays, tensors[row, DECAY] + phase)
        added = added + _update(tensor, gradient, first, second, k, decay, rates[row])
        phase += LANES
        if phase == period:
            phase = 0
    if whole < end:  # the last few, in a place with room for sixteen
        room = np.zeros(4 * LANES, np.float32)
        at, line = room.ctypes.data, 4 * LANES
        for column in range(4):
            _copy(at + column * line, tensors[row, column] + 4 * whole, end - whole)
        decay = load(decays, tensors[row, DECAY] + phase)
        added = added + _update(at, at + line, at + 2 * line, at + 3 * line, 0, decay, rates[row])
        for column in (TENSOR, FIRST, SECOND):
            _copy(tensors[row, column] + 4 * whole, at + column * line, end - whole)
        room[0] = 0.0  # Numba frees an array after its last use, of which its address is none
    sums[task] = total(added)


@kernel
def step(tensors, rates, decays, sums):
    """Steps all tensors, which are float32 and contiguous.

    Args:
        tensors: [n, 8] int64, columns as above.
        rates: [n, 5] float32: learning rate over 1 - beta1^t, beta1, beta2, 1 / sqrt(1 - beta2^t), eps.
        decays: what is added to the gradient, in numbers of the tensor; see the column DECAY.
        sums: out [tasks], one for each SHARE numbers of a tensor: their sum after the step.
    """
    parallel_for(_share, sums.shape[0], (tensors, rates, decays, sums))


@inline
def square_rows(task, tensor, columns, sums):
    """``square_columns`` of a share of the rows."""
    count = tensor.shape[0] // columns
    for column in range(0, columns, LANES):
        added = splat(0.0)
        for row in range(task * SQUARED_ROWS, min((task + 1) * SQUARED_ROWS, count)):
            (x,) = load_columns(tensor, row * columns + column, 1, columns - column)
            added = added + x * x
        store_columns(sums, task * columns + column, (added,), columns - column)


@kernel
def square_columns(tensor, columns, sums):
    """Sums of squares of the columns of a matrix, over SQUARED_ROWS rows each.

    Args:
        tensor: [rows * columns] float32.
        columns: of the matrix.
        sums: out [shares, columns].
    """
    parallel_for(square_rows, sums.shape[0], (tensor, columns, sums))
