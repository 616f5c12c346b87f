"""Frozen dataclasses as compile-time constants: a kernel is compiled once for each value that it is called with."""

from __future__ import annotations

import functools
from typing import Any

from llvmlite import ir
from numba.core import ir as numba_ir
from numba.core import types
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.consts import ConstantInference
from numba.core.ir_utils import get_definition, guard
from numba.extending import NativeValue, intrinsic, models, register_model, typeof_impl, unbox

_i64 = ir.IntType(64)
_FIELDS: dict[Any, str] = {}  # what ``constant`` made -> the name it was made of


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

    _FIELDS[function] = name
    return function


@register_pass(mutates_CFG=True, analysis_only=False)
class FoldConstants(FunctionPass):
    """Writes calls of what ``constant`` made as numbers, before Numba prunes branches that are never taken.

    Whatever a kernel does only for other values is then neither typed nor lowered. (LLVM would drop it, too, but of compiling a
    kernel its optimisation is the smaller part.)
    """

    _name = "fold_constants"

    def __init__(self) -> None:  # abstract in Numba
        super().__init__()

    def run_pass(self, state: Any) -> bool:
        function_ir = state.func_ir
        found = False
        for block in function_ir.blocks.values():
            for statement in block.find_insts(numba_ir.Assign):
                number = guard(_number, function_ir, state.args, statement.value)
                if number is not None:
                    of_target = function_ir._definitions[statement.target.name]
                    of_target[of_target.index(statement.value)] = number
                    statement.value, found = number, True
        if found:
            function_ir._consts = ConstantInference(function_ir)
        return found


def _number(function_ir: Any, arguments: tuple, value: Any) -> numba_ir.Const | None:
    """The number that a call of what ``constant`` made gives; None for any other expression."""
    if not isinstance(value, numba_ir.Expr) or value.op != "call":
        return None
    name = _FIELDS.get(getattr(get_definition(function_ir, value.func), "value", None))
    given = get_definition(function_ir, value.args[0]) if name else None
    kind = arguments[given.index] if isinstance(given, numba_ir.Arg) else None
    return numba_ir.Const(int(getattr(kind.value, name)), value.loc) if isinstance(kind, ConstantType) else None
