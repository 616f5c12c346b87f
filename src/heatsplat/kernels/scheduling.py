"""Work that threads take as they become free."""

from __future__ import annotations

import numba
from numba.core import types
from numba.extending import intrinsic


@intrinsic
def take(typing_context, counter, amount):
    """The number in ``counter[0]`` (int64), which grows by ``amount`` at the same moment; safe between threads.

    Tasks differ in work by what they hold, so equal shares would leave threads idle: each thread takes the next task when
    it is done with one. Results must not depend on who takes which.
    """

    def generate(context, builder, signature, values):
        data = context.make_array(counter)(context, builder, values[0]).data
        amount = context.cast(builder, values[1], types.unliteral(signature.args[1]), types.int64)
        return builder.atomic_rmw("add", data, amount, "monotonic")

    return types.int64(counter, amount), generate


def use_threads(count: int) -> None:
    """Makes the kernels run on ``count`` threads from now on, or on as many as there are (NUMBA_NUM_THREADS)."""
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))


def thread_count() -> int:
    """How many threads kernels run on (``use_threads`` sets it)."""
    return numba.get_num_threads()
