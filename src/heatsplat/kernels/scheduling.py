"""Work shared out among threads."""

from __future__ import annotations

import numba
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import intrinsic

_i64, _address = ir.IntType(64), ir.IntType(8).as_pointer()


def _borrowed(context, builder, kind: types.Type, value):
    """An array without its owner: tasks need not count references to what their caller keeps (measured: 1.8 times as slow)."""
    if not isinstance(kind, types.Array):
        return value
    array = context.make_array(kind)(context, builder, value)
    array.meminfo, array.parent = (cgutils.get_null_value(owner.type) for owner in (array.meminfo, array.parent))
    return array._getvalue()


@intrinsic
def parallel_for(typing_context, task, count, arguments):
    """Calls ``task(k, *arguments)`` for each k below ``count``, an equal share of neighbours on each thread.

    This is what Numba's ``prange`` comes down to, a call of its pool of threads, without the passes that turn a loop's
    body into a function: they more than double the time of compilation (measured: 10 of 25 s of a first run).

    Args:
        task: a function made by ``inline`` that returns nothing and raises nothing.
        count: how many tasks there are; a single one, or a single thread, does not wake the pool.
        arguments: a tuple of what all tasks take.
    """
    if not isinstance(task, types.Dispatcher) or not isinstance(arguments, types.BaseTuple):
        return None
    kinds = types.int64, *map(types.unliteral, arguments.types)
    task_signature = task.get_call_type(typing_context, kinds, {})

    def generate(context, builder, signature, values):
        compiled = task.dispatcher.overloads[task_signature.args]
        context.add_linking_libs([compiled.library])
        shared = [
            context.cast(builder, value, given, kind)
            for value, given, kind in zip(
                cgutils.unpack_tuple(builder, values[2]), arguments.types, kinds[1:], strict=True
            )
        ]
        closure = cgutils.alloca_once(builder, ir.LiteralStructType([value.type for value in shared]))
        for position, value in enumerate(shared):
            builder.store(value, cgutils.gep_inbounds(builder, closure, 0, position))

        # Called with the first k as an address, how many there are, and the closure: an inner loop of NumPy, as the pool
        # wants it.
        loop_type = ir.FunctionType(
            ir.VoidType(), [_address.as_pointer(), _i64.as_pointer(), _i64.as_pointer(), _address]
        )
        body = ir.Function(builder.module, loop_type, builder.module.get_unique_name(f"{builder.function.name}.tasks"))
        body.linkage = "internal"
        body.attributes.add("noinline")
        inner = ir.IRBuilder(body.append_basic_block())
        first = inner.ptrtoint(inner.load(body.args[0]), _i64)
        fields = inner.load(inner.bitcast(body.args[3], closure.type))
        taken = [
            _borrowed(context, inner, kind, inner.extract_value(fields, position))
            for position, kind in enumerate(kinds[1:])
        ]
        with cgutils.for_range(inner, inner.load(body.args[1])) as loop:
            context.call_internal_no_propagate(
                inner, compiled.fndesc, task_signature, [inner.add(first, loop.index), *taken]
            )
        inner.ret_void()

        number = context.cast(builder, values[1], signature.args[1], types.int64)
        base, counts, steps = (cgutils.alloca_once_value(builder, value) for value in (_address(None), number, _i64(1)))
        threads = builder.call(
            cgutils.get_or_insert_function(builder.module, ir.FunctionType(_i64, []), "get_num_threads"), []
        )
        data = builder.bitcast(closure, _address)
        alone = builder.or_(builder.icmp_signed("<=", number, _i64(1)), builder.icmp_signed("<=", threads, _i64(1)))
        with builder.if_else(alone) as (by_itself, in_pool):
            with by_itself:
                builder.call(body, [base, counts, steps, data])
            with in_pool:
                pool_kind = ir.FunctionType(ir.VoidType(), [_address] * 5 + [_i64] * 3)
                pool = cgutils.get_or_insert_function(builder.module, pool_kind, "numba_parallel_for")
                pointers = [builder.bitcast(value, _address) for value in (body, base, counts, steps)]
                builder.call(pool, [*pointers, data, _i64(0), _i64(1), threads])
        return context.get_dummy_value()

    return types.void(task, count, arguments), generate


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
