"""Frozen dataclasses as compile-time constants: a kernel is compiled once for each value that it is called with."""

from __future__ import annotations

import functools
from typing import Any

from llvmlite import ir
from numba.core import types
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox

_i64 = ir.IntType(64)


class ConstantType(types.Type):
    """Numba type of one value; what is passed along carries nothing."""

    def __init__(self, value: Any) -> None:
        self.value = value
        super().__init__(repr(value))


@register_model(ConstantType)
class _ConstantModel(models.OpaqueModel):
    pass


@unbox(ConstantType)
def _unbox_constant(numba_type, value, c):
    return NativeValue(c.context.get_dummy_value())


def compile_time(kind: type) -> type:
    """The frozen dataclass ``kind``, whose values kernels may take as arguments."""
    type_of = functools.cache(ConstantType)  # asked for at every call of a kernel
    typeof_impl.register(kind)(lambda value, _: type_of(value))
    return kind


def constant(name: str):
    """An intrinsic that gives a field or property of such a value, a whole number or a flag, as a literal."""

    @intrinsic
    def function(typing_context, given):
        if not isinstance(given, ConstantType):
            return None
        number = int(getattr(given.value, name))
        return types.literal(number)(given), lambda context, builder, signature, values: ir.Constant(_i64, number)

    return function
