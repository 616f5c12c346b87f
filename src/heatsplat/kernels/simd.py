"""Sixteen lanes as a value: the SIMD type that the kernels are written in.

Numba does not vectorise these kernels by itself (rounding, exp and early exits stop it), so vectors are spelled out.
A value of type ``float32x16`` adds, multiplies and compares like a number; numbers mix in as if copied to all lanes; a
comparison gives a ``mask16``, which ``select``, ``bits`` and ``first_lanes`` deal in. LLVM lowers sixteen lanes to one
AVX-512 register, two of AVX or four of SSE and NEON (twice as many of ``float64x16``), so nothing here names a machine.

**Convention:** lane k of a load is element ``offset + k`` of the flat array; lane k of a mask is bit k of its ``bits``.

The plain twin of a function here is the NumPy function of its name on an array of sixteen (tests/kernels/test_simd.py).
"""

from __future__ import annotations

import operator

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.errors import TypingError
from numba.core.typing import signature
from numba.core.typing.templates import AbstractTemplate, infer_global
from numba.extending import (
    intrinsic,
    lower_builtin,
    models,
    overload,
    register_model,
    type_callable,
)

from heatsplat.kernels.compilation import inline

LANES = 16

_f32, _f64 = ir.FloatType(), ir.DoubleType()
_i1, _i16, _i32, _i64 = ir.IntType(1), ir.IntType(16), ir.IntType(32), ir.IntType(64)
_ALIGN_4 = ir.Constant(_i32, 4)


class LaneType(types.Type):
    """Numba type of sixteen values of one LLVM element type."""

    def __init__(self, name: str, element: ir.Type) -> None:
        self.element = element
        super().__init__(name)


@register_model(LaneType)
class _LaneModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, ir.VectorType(fe_type.element, LANES))


float32x16 = LaneType("float32x16", _f32)
float64x16 = LaneType("float64x16", _f64)
int32x16 = LaneType("int32x16", _i32)
mask16 = LaneType("mask16", _i1)

_NUMBERS = {float32x16: types.float32, float64x16: types.float64, int32x16: types.int32}
_DTYPES = {number: lane_type for lane_type, number in _NUMBERS.items()}
_FLOATS = float32x16, float64x16
_SUFFIXES = {float32x16: "f32", float64x16: "f64", int32x16: "i32"}  # of LLVM's intrinsics


# ---- building blocks of the code generation ----


def _vector(count: int, element: ir.Type = _f32) -> ir.VectorType:
    return ir.VectorType(element, count)


def _constant(values, element: ir.Type) -> ir.Constant:
    return ir.Constant(_vector(len(values), element), list(values))


def _splat(builder, scalar, count: int = LANES):
    vector = _vector(count, scalar.type)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, ir.Constant(_i32, 0))
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), _constant([0] * count, _i32))


def _as_lanes(context, builder, value, actual: types.Type, lane_type: LaneType):
    """``value`` as a vector of ``lane_type``: itself, or a number copied to all lanes."""
    if isinstance(actual, LaneType):
        return value
    number = context.cast(builder, value, types.unliteral(actual), _NUMBERS[lane_type])
    return _splat(builder, number)


def _llvm(builder, name: str, result: ir.Type, *arguments):
    function_type = ir.FunctionType(result, [argument.type for argument in arguments])
    return builder.call(cgutils.get_or_insert_function(builder.module, function_type, name), arguments)


def _lane_type(*arguments: types.Type) -> LaneType | None:
    """The lane type of an operation between lanes and numbers, or None where it is none."""
    lanes = {argument for argument in arguments if isinstance(argument, LaneType)}
    others = [argument for argument in arguments if not isinstance(argument, LaneType)]
    if len(lanes) != 1 or not all(isinstance(other, types.Number) for other in others):
        return None
    return lanes.pop()


def _elementwise(emit):
    """An intrinsic over lanes and numbers from ``emit(builder, *vectors)``, typed by the number of its arguments."""

    def typed(typing_context, *arguments):
        lane_type = _lane_type(*arguments)
        if lane_type is None:
            return None

        def generate(context, builder, signature, values):
            vectors = [
                _as_lanes(context, builder, value, actual, lane_type)
                for value, actual in zip(values, signature.args, strict=True)
            ]
            return emit(builder, *vectors)

        return lane_type(*arguments), generate

    return typed


# ---- operators ----


def _define_operator(function, emit: dict[LaneType, object], result: LaneType | None = None, arity: int = 2) -> None:
    """Teaches ``function`` (of the operator module) to take lanes; ``emit`` maps a lane type to builder calls."""

    @infer_global(function)
    class Typing(AbstractTemplate):
        metadata = {"target": "cpu"}  # as special as that is asked first, not after lists, dates and text

        def generic(self, arguments, _):
            lane_type = _lane_type(*arguments)
            return signature(result or lane_type, *arguments) if lane_type in emit else None

    def generate(context, builder, signature, values):
        lane_type = _lane_type(*signature.args)
        vectors = [
            _as_lanes(context, builder, value, actual, lane_type)
            for value, actual in zip(values, signature.args, strict=True)
        ]
        return emit[lane_type](builder, *vectors)

    shapes = [(LaneType,)] if arity == 1 else [(LaneType, LaneType), (LaneType, types.Number), (types.Number, LaneType)]
    for shape in shapes:
        lower_builtin(function, *shape)(generate)


def _compare(predicate: str):
    return dict.fromkeys(_FLOATS, lambda builder, a, b: builder.fcmp_ordered(predicate, a, b)) | {
        int32x16: lambda builder, a, b: builder.icmp_signed(predicate, a, b),
    }


for _function, _of_floats, _of_integers in (
    (operator.add, lambda b, x, y: b.fadd(x, y), lambda b, x, y: b.add(x, y)),
    (operator.sub, lambda b, x, y: b.fsub(x, y), lambda b, x, y: b.sub(x, y)),
    (operator.mul, lambda b, x, y: b.fmul(x, y), lambda b, x, y: b.mul(x, y)),
):
    _define_operator(_function, dict.fromkeys(_FLOATS, _of_floats) | {int32x16: _of_integers})
_define_operator(operator.truediv, dict.fromkeys(_FLOATS, lambda b, x, y: b.fdiv(x, y)))
_define_operator(operator.neg, dict.fromkeys(_FLOATS, lambda b, x: b.fneg(x)), arity=1)
_define_operator(operator.lshift, {int32x16: lambda b, x, y: b.shl(x, y)})
_define_operator(operator.rshift, {int32x16: lambda b, x, y: b.ashr(x, y)})
_define_operator(operator.and_, {kind: lambda b, x, y: b.and_(x, y) for kind in (mask16, int32x16)})
_define_operator(operator.or_, {kind: lambda b, x, y: b.or_(x, y) for kind in (mask16, int32x16)})
_define_operator(operator.invert, {mask16: lambda b, x: b.not_(x)}, arity=1)
for _function, _predicate in (
    (operator.lt, "<"), (operator.le, "<="), (operator.gt, ">"), (operator.ge, ">="), (operator.eq, "=="),
):  # fmt: skip
    _define_operator(_function, _compare(_predicate), result=mask16)


# ---- lanes from numbers and back ----


@intrinsic
def splat(typing_context, value):
    """A number in all lanes; float32 or int32 by its type."""
    lane_type = float32x16 if isinstance(value, types.Float) else int32x16

    def generate(context, builder, signature, values):
        return _as_lanes(context, builder, values[0], signature.args[0], lane_type)

    return lane_type(value), generate


@intrinsic
def filled(typing_context, array, value):
    """A number in all lanes, of the type of an array's elements."""
    lane_type = _flat(array)
    if lane_type is None:
        raise TypingError(f"filled needs a contiguous array whose elements are lanes, got {array}")

    def generate(context, builder, signature, values):
        return _as_lanes(context, builder, values[1], signature.args[1], lane_type)

    return lane_type(array, value), generate


@intrinsic
def lane_indices(typing_context):
    """0, 1, ... 15 as int32x16."""
    return int32x16(), lambda context, builder, signature, values: _constant(range(LANES), _i32)


@intrinsic
def to_float(typing_context, x):
    """Integers as floats."""
    return float32x16(x), lambda context, builder, signature, values: builder.sitofp(values[0], _vector(LANES))


@intrinsic
def to_int(typing_context, x):
    """Floats truncated towards zero; the caller keeps them inside the range of int32."""
    return int32x16(x), lambda context, builder, signature, values: builder.fptosi(values[0], _vector(LANES, _i32))


@intrinsic
def bits_of_floats(typing_context, x):
    """The bit patterns of floats as int32x16."""
    return int32x16(x), lambda context, builder, signature, values: builder.bitcast(values[0], _vector(LANES, _i32))


@intrinsic
def floats_of_bits(typing_context, x):
    """The floats whose bit patterns these integers are."""
    return float32x16(x), lambda context, builder, signature, values: builder.bitcast(values[0], _vector(LANES))


@intrinsic
def bits(typing_context, mask):
    """A mask as an integer, lane k as bit k."""
    if mask != mask16:
        return None

    def generate(context, builder, signature, values):
        return builder.zext(builder.bitcast(values[0], _i16), _i64)

    return types.int64(mask), generate


@intrinsic
def bytes_of(typing_context, x):
    """The low bytes of integers as two int64: lanes 0-7 and lanes 8-15, the first lane lowest."""
    if x != int32x16:
        return None

    def generate(context, builder, signature, values):
        small = builder.trunc(values[0], _vector(LANES, ir.IntType(8)))
        words = builder.bitcast(small, _vector(2, _i64))
        halves = [builder.extract_element(words, ir.Constant(_i32, k)) for k in range(2)]
        return context.make_tuple(builder, signature.return_type, halves)

    return types.UniTuple(types.int64, 2)(x), generate


@intrinsic
def mask_of(typing_context, number):
    """The mask whose lane k is bit k of an integer."""

    def generate(context, builder, signature, values):
        number = context.cast(builder, values[0], types.unliteral(signature.args[0]), types.int64)
        return builder.bitcast(builder.trunc(number, _i16), _vector(LANES, _i1))

    return mask16(number), generate


@intrinsic
def first_lanes(typing_context, count):
    """A mask of the lanes below ``count``."""

    def generate(context, builder, signature, values):
        count = context.cast(builder, values[0], types.unliteral(signature.args[0]), types.int32)
        return builder.icmp_signed("<", _constant(range(LANES), _i32), _splat(builder, count))

    return mask16(count), generate


@intrinsic
def total(typing_context, x):
    """The sum over lanes, in a fixed order (halves folded onto each other)."""
    if x not in _FLOATS:
        return None

    def generate(context, builder, signature, values):
        vector, width = values[0], LANES
        while width > 1:
            width //= 2
            low = builder.shuffle_vector(vector, vector, _constant(range(width), _i32))
            high = builder.shuffle_vector(vector, vector, _constant(range(width, 2 * width), _i32))
            vector = builder.fadd(low, high)
        return builder.extract_element(vector, ir.Constant(_i32, 0))

    return _NUMBERS[x](x), generate


# ---- arithmetic ----


def _unary(name: str):
    @intrinsic
    def function(typing_context, x):
        if x not in _FLOATS:
            return None
        called, vector = f"llvm.{name}.v16{_SUFFIXES[x]}", _vector(LANES, x.element)
        return x(x), lambda context, builder, signature, values: _llvm(builder, called, vector, values[0])

    return function


sqrt = _unary("sqrt")
floor = _unary("floor")
ceil = _unary("ceil")
absolute = _unary("fabs")


@intrinsic
def minimum(typing_context, x, y):
    """The smaller of two; ``y`` where either is NaN."""
    return _elementwise(lambda b, x, y: b.select(b.fcmp_ordered("<", x, y), x, y))(typing_context, x, y)


@intrinsic
def maximum(typing_context, x, y):
    """The larger of two; ``y`` where either is NaN."""
    return _elementwise(lambda b, x, y: b.select(b.fcmp_ordered(">", x, y), x, y))(typing_context, x, y)


@intrinsic
def select(typing_context, mask, x, y):
    """``x`` where the mask is set, else ``y``."""
    lane_type = _lane_type(x, y)
    if mask != mask16 or lane_type is None:
        return None

    def generate(context, builder, signature, values):
        yes = _as_lanes(context, builder, values[1], signature.args[1], lane_type)
        no = _as_lanes(context, builder, values[2], signature.args[2], lane_type)
        return builder.select(values[0], yes, no)

    return lane_type(mask, x, y), generate


# ---- memory ----


def _flat(array: types.Type) -> LaneType | None:
    """The lane type of a C-contiguous array, None where it has none."""
    if isinstance(array, types.Array) and array.layout == "C":
        return _DTYPES.get(array.dtype)
    return None


def _pointer(context, builder, array_type, array, offset, offset_type, count: int):
    """Address of element ``offset`` of the flat array, as a pointer to ``count`` elements."""
    data = context.make_array(array_type)(context, builder, array).data
    offset = context.cast(builder, offset, types.unliteral(offset_type), types.int64)
    address = builder.gep(data, [offset])
    return builder.bitcast(address, _vector(count, _DTYPES[array_type.dtype].element).as_pointer())


@intrinsic
def load(typing_context, array, offset):
    """Sixteen elements of a contiguous array, from ``offset`` of its flat order."""
    lane_type = _flat(array)
    if lane_type is None:
        raise TypingError(f"load needs a contiguous array of float32, float64 or int32, got {array}")

    def generate(context, builder, signature, values):
        pointer = _pointer(context, builder, array, values[0], values[1], signature.args[1], LANES)
        return builder.load(pointer, align=4)

    return lane_type(array, offset), generate


@intrinsic
def store(typing_context, array, offset, value):
    """Writes sixteen elements of a contiguous array, from ``offset`` of its flat order."""
    if _flat(array) is None or _flat(array) != value:
        raise TypingError(f"store needs a contiguous array of the value's type, got {array} and {value}")

    def generate(context, builder, signature, values):
        pointer = _pointer(context, builder, array, values[0], values[1], signature.args[1], LANES)
        builder.store(values[2], pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, offset, value), generate


@inline
def load_vector(array, k):
    """Vector ``k`` of a contiguous array whose last axis has sixteen elements."""
    return load(array, k * LANES)


@inline
def store_vector(array, k, value):
    """Writes vector ``k`` of a contiguous array whose last axis has sixteen elements."""
    store(array, k * LANES, value)


@intrinsic
def store_first(typing_context, array, offset, value, count):
    """Writes the first ``count`` lanes of a vector, from ``offset`` of the array's flat order."""

    def generate(context, builder, signature, values):
        pointer = _pointer(context, builder, array, values[0], values[1], signature.args[1], LANES)
        mask = _rows_mask(builder, context, values[3], signature.args[3], 1)
        _llvm(builder, "llvm.masked.store.v16f32.p0", ir.VoidType(), values[2], pointer, _ALIGN_4, mask)
        return context.get_dummy_value()

    return types.void(array, offset, value, count), generate


@intrinsic
def load_scalar(typing_context, array, offset):
    """Element ``offset`` of a contiguous array in its flat order, without wrap-around of negative indices."""
    if not isinstance(array, types.Array) or array.layout != "C":
        raise TypingError(f"load_scalar needs a contiguous array, got {array}")

    def generate(context, builder, signature, values):
        data = context.make_array(array)(context, builder, values[0]).data
        offset = context.cast(builder, values[1], types.unliteral(signature.args[1]), types.int64)
        return builder.load(builder.gep(data, [offset]))

    return array.dtype(array, offset), generate


@intrinsic
def store_scalar(typing_context, array, offset, value):
    """Writes element ``offset`` of a contiguous array in its flat order, without wrap-around of negative indices."""
    if not isinstance(array, types.Array) or array.layout != "C":
        raise TypingError(f"store_scalar needs a contiguous array, got {array}")

    def generate(context, builder, signature, values):
        data = context.make_array(array)(context, builder, values[0]).data
        offset = context.cast(builder, values[1], types.unliteral(signature.args[1]), types.int64)
        builder.store(values[2], builder.gep(data, [offset]))
        return context.get_dummy_value()

    return types.void(array, offset, array.dtype), generate


def _rows_mask(builder, context, rows, rows_type, columns: int):
    """A mask of the numbers of the first ``rows`` rows of sixteen."""
    limit = context.cast(builder, rows, types.unliteral(rows_type), types.int32)
    limit = builder.mul(limit, ir.Constant(_i32, columns))
    count = LANES * columns
    return builder.icmp_signed("<", _constant(range(count), _i32), _splat(builder, limit, count))


@intrinsic(prefer_literal=True)
def load_columns(typing_context, array, row, columns, rows):
    """The columns of sixteen rows of a contiguous [N, columns] array, one vector each; rows from ``rows`` on read 0.

    Args:
        array: contiguous [N, columns] of float32.
        row: the first row.
        columns: a literal; how many numbers make a row.
        rows: how many rows there are from ``row`` on; sixteen or more reads all lanes.
    """
    lane_type = _flat(array)
    if lane_type is None or not isinstance(columns, types.IntegerLiteral):
        raise TypingError(f"load_columns needs a contiguous array and a literal count, got {array}, {columns}")
    width = columns.literal_value
    count = LANES * width

    def generate(context, builder, signature, values):
        row = context.cast(builder, values[1], types.unliteral(signature.args[1]), types.int64)
        offset = builder.mul(row, ir.Constant(_i64, width))
        pointer = _pointer(context, builder, array, values[0], offset, types.int64, count)
        mask = _rows_mask(builder, context, values[3], signature.args[3], width)
        wide = _vector(count, lane_type.element)
        name = f"llvm.masked.load.v{count}{_SUFFIXES[lane_type]}.p0"
        loaded = _llvm(builder, name, wide, pointer, _ALIGN_4, mask, ir.Constant(wide, None))
        picked = [
            builder.shuffle_vector(loaded, loaded, _constant(range(column, count, width), _i32))
            for column in range(width)
        ]
        return context.make_tuple(builder, signature.return_type, picked)

    return types.UniTuple(lane_type, width)(array, row, columns, rows), generate


@intrinsic
def store_columns(typing_context, array, row, columns, rows):
    """Writes vectors as the columns of sixteen rows of a contiguous [N, len(columns)] array, ``rows`` rows at most."""
    lane_type = _flat(array)
    if lane_type is None or not isinstance(columns, types.UniTuple) or columns.dtype != lane_type:
        raise TypingError(f"store_columns needs a contiguous array and a tuple of its lanes, got {array}, {columns}")
    width = columns.count
    count = LANES * width

    def generate(context, builder, signature, values):
        row = context.cast(builder, values[1], types.unliteral(signature.args[1]), types.int64)
        offset = builder.mul(row, ir.Constant(_i64, width))
        pointer = _pointer(context, builder, array, values[0], offset, types.int64, count)
        mask = _rows_mask(builder, context, values[3], signature.args[3], width)
        vectors = cgutils.unpack_tuple(builder, values[2], width)
        wide = _interleaved(builder, vectors)
        name = f"llvm.masked.store.v{count}{_SUFFIXES[lane_type]}.p0"
        # Masked stores that miss the cache take twice as long as whole ones (measured on Zen 5).
        rows = context.cast(builder, values[3], types.unliteral(signature.args[3]), types.int64)
        with builder.if_else(builder.icmp_signed(">=", rows, ir.Constant(_i64, LANES))) as (whole, part):
            with whole:
                builder.store(wide, pointer, align=4)
            with part:
                _llvm(builder, name, ir.VoidType(), wide, pointer, _ALIGN_4, mask)
        return context.get_dummy_value()

    return types.void(array, row, columns, rows), generate


def _interleaved(builder, vectors):
    """Vectors a, b, ... as one: a0 b0 ... a1 b1 ..."""
    joined, width = vectors[0], 1
    for vector in vectors[1:]:
        padded = builder.shuffle_vector(
            vector, vector, _constant([k if k < LANES else 0 for k in range(LANES * width)], _i32)
        )
        order = []
        for row in range(LANES):
            order += [row * width + column for column in range(width)] + [LANES * width + row]
        joined = builder.shuffle_vector(joined, padded, _constant(order, _i32))
        width += 1
    return joined


@intrinsic
def prefetch(typing_context, array, offset):
    """Asks for the cache line of element ``offset`` ahead of its use; any offset is safe."""

    def generate(context, builder, signature, values):
        data = context.make_array(array)(context, builder, values[0]).data
        offset = context.cast(builder, values[1], types.unliteral(signature.args[1]), types.int64)
        address = builder.gep(data, [offset])
        arguments = [ir.Constant(_i32, number) for number in (0, 3, 1)]  # read, keep in all levels, data
        _llvm(builder, "llvm.prefetch.p0", ir.VoidType(), address, *arguments)
        return context.get_dummy_value()

    return types.void(array, offset), generate


# ---- vectors kept in registers ----


class RegistersType(types.Type):
    """Numba type of a fixed number of float32x16."""

    def __init__(self, count: int) -> None:
        self.count = count
        super().__init__(f"registers({count})")


@register_model(RegistersType)
class _RegistersModel(models.PrimitiveModel):
    def __init__(self, dmm, fe_type):
        super().__init__(dmm, fe_type, ir.ArrayType(_vector(LANES), fe_type.count).as_pointer())


@intrinsic(prefer_literal=True)
def registers(typing_context, count):
    """``count`` (a literal) vectors, indexed like a list; LLVM keeps them in registers once loops are unrolled."""
    if not isinstance(count, types.IntegerLiteral):
        raise TypingError(f"registers needs a literal count, got {count}")
    result = RegistersType(count.literal_value)

    def generate(context, builder, signature, values):
        return cgutils.alloca_once(builder, ir.ArrayType(_vector(LANES), result.count))

    return result(count), generate


def _register_address(context, builder, pointer, index, index_type):
    index = context.cast(builder, index, types.unliteral(index_type), types.int64)
    return builder.gep(pointer, [ir.Constant(_i64, 0), index])


@type_callable(operator.getitem)
def _type_get_register(context):
    def resolve(array, index):
        return float32x16 if isinstance(array, RegistersType) and isinstance(index, types.Integer) else None

    return resolve


@lower_builtin(operator.getitem, RegistersType, types.Integer)
def _get_register(context, builder, signature, values):
    return builder.load(_register_address(context, builder, *values, signature.args[1]))


@type_callable(operator.setitem)
def _type_set_register(context):
    def resolve(array, index, value):
        if isinstance(array, RegistersType) and isinstance(index, types.Integer) and value == float32x16:
            return types.void
        return None

    return resolve


@lower_builtin(operator.setitem, RegistersType, types.Integer, LaneType)
def _set_register(context, builder, signature, values):
    builder.store(values[2], _register_address(context, builder, *values[:2], signature.args[1]))
    return context.get_dummy_value()


@intrinsic
def totals(typing_context, vectors):
    """The sums over lanes of up to sixteen ``registers``: sum k in lane k of one vector, undefined in other lanes.

    Vectors are folded two into one, each to half the lanes, so a sum costs little more than one addition.
    """
    if not isinstance(vectors, RegistersType) or vectors.count > LANES:
        return None

    def generate(context, builder, signature, values):
        loaded = builder.load(values[0])
        folded = [builder.extract_value(loaded, k) for k in range(vectors.count)]
        width = LANES  # lanes that hold the parts of one sum
        while width > 1:
            starts = range(0, folded[0].type.count * min(len(folded), 2), width)
            width //= 2
            low = [start + k for start in starts for k in range(width)]
            low, high = (_constant([k + shift for k in low], _i32) for shift in (0, width))
            pairs = zip(folded[::2], [*folded[1::2], folded[-1]], strict=False)
            folded = [
                builder.fadd(builder.shuffle_vector(a, b, low), builder.shuffle_vector(a, b, high)) for a, b in pairs
            ]
        return _padded(builder, folded[0])

    return float32x16(vectors), generate


def _padded(builder, vector):
    """A shorter vector with undefined lanes up to sixteen."""
    count = vector.type.count
    return builder.shuffle_vector(vector, vector, _constant([k % count for k in range(LANES)], _i32))


# ---- scalar bit tricks ----


@intrinsic
def lowest_bit(typing_context, number):
    """Position of the lowest set bit of a non-zero integer."""

    def generate(context, builder, signature, values):
        number = context.cast(builder, values[0], types.unliteral(signature.args[0]), types.int64)
        return _llvm(builder, "llvm.cttz.i64", _i64, number, ir.Constant(_i1, 1))

    return types.int64(number), generate


# ---- functions of lanes ----

_LOG2_E = np.float32(1.4426950408889634)
_ROUND = np.float32(1.5 * 2**23)  # adding it leaves the nearest integer in the low bits
_SQRT_HALF_BITS = np.int32(0x3F3504F3)


@inline
def exp2(x):
    """2 to the power of x, relative error below 2e-7, for -126 <= x < 128; anything at all for other x."""
    shifted = x + _ROUND
    x = x - (shifted - _ROUND)
    # Minimax on [-1/2, 1/2] with 2^0 = 1: 9.2e-8. Pairs instead of Horner's rule: a third of the latency.
    square = x * x
    low = x * np.float32(6.9314698e-1) + np.float32(1.0)
    middle = x * np.float32(5.550734e-2) + np.float32(2.4022242e-1)
    high = x * np.float32(1.32647e-3) + np.float32(9.67151e-3)
    power = (high * square + middle) * square + low
    return floats_of_bits(bits_of_floats(power) + (bits_of_floats(shifted) << 23))


@intrinsic
def _exp_of_doubles(typing_context, x):
    vector = _vector(LANES, _f64)
    return x(x), lambda context, builder, signature, values: _llvm(builder, "llvm.exp.v16f64", vector, values[0])


def exp(x):
    """e to the power of x: float32 to 3e-7 for -87 <= x < 88 and 1e-38 below; float64 as the C library has it."""
    raise TypeError(f"exp takes lanes, which are there inside kernels only, not {type(x).__name__}")


@overload(exp)
def _exp(x):
    if x == float32x16:
        return lambda x: exp2(maximum(x * _LOG2_E, np.float32(-126.0)))
    return (lambda x: _exp_of_doubles(x)) if x == float64x16 else None


@inline
def log2(x):
    """Logarithm to base 2 of positive normal numbers, absolute error below 1e-6 for results up to 16."""
    distance = bits_of_floats(x) - _SQRT_HALF_BITS
    exponent = distance >> 23
    x = floats_of_bits(bits_of_floats(x) - (exponent << 23)) - np.float32(1.0)  # in [sqrt(1/2) - 1, sqrt(2) - 1]
    series = x * np.float32(-0.1457445) + np.float32(0.23689039)  # minimax of log2(1 + x) / x: 4.9e-8
    series = series * x + np.float32(-0.25006904)
    series = series * x + np.float32(0.28670745)
    series = series * x + np.float32(-0.36008722)
    series = series * x + np.float32(0.48093944)
    series = series * x + np.float32(-0.72135715)
    series = series * x + np.float32(1.4426948)
    return series * x + to_float(exponent)
