"""Work that threads take as they become free."""

from __future__ import annotations

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic


@intrinsic
def take(typing_context, counter):
    """The number in ``counter[0]`` (int64), which then counts on by one; safe between threads.

    A tile's work depends on its content, so equal shares of tiles would leave threads idle (tiles do not depend on each
    other, so the result does not depend on who takes which).
    """

    def generate(context, builder, signature, values):
        data = context.make_array(counter)(context, builder, values[0]).data
        return builder.atomic_rmw("add", data, ir.Constant(ir.IntType(64), 1), "monotonic")

    return types.int64(counter), generate


def thread_count() -> int:
    """How many threads kernels run on (``numba.set_num_threads`` and NUMBA_NUM_THREADS set it)."""
    return numba.get_num_threads()
