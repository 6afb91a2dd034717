"""Sixteen numbers at once: the lane-wise operations that the rasterizer's inner loops are written in.

In compiled kernels a `Lanes` is one LLVM vector of 16 float32 or float64, and a mask one of 16 bits: on a CPU with
AVX-512 a float32 operation is one instruction, elsewhere LLVM splits it. LLVM's own vectorizer doesn't find these
loops: plain ones take 3x the time. Without the compiler the very same kernels run on NumPy arrays of 16, which is what
each function's body does.
"""

import operator
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.extending import lower_builtin, register_model, type_callable

from msdgs_serve.rasterizer.jit import FAST_MATH

LANES = 16

Lanes = Any
"""16 numbers: an LLVM vector in kernels, an array [16] without the compiler."""
Mask = Any
"""16 truth values."""
Index = int | np.integer
"""A place or a set of bits. Kernels use np.uint64 for them, or numba compiles a test for negative ones into every
access: 3.5x."""


class LanesType(types.Type):
    """What numba calls 16 numbers of a type, or 32 of a `pair`."""

    def __init__(self, dtype: types.Type, count: int = LANES) -> None:
        self.dtype, self.count = dtype, count
        super().__init__(f"Lanes({dtype}, {count})")


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, ir.VectorType(manager.lookup(fe_type.dtype).get_data_type(), fe_type.count))


class MaskType(types.Type):
    """What numba calls 16 truth values, or 32."""

    def __init__(self, count: int = LANES) -> None:
        self.count = count
        super().__init__(f"Mask({count})")


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, ir.VectorType(ir.IntType(1), fe_type.count))


MASK = MaskType()
REALS = (types.float32, types.float64)
FREEDOMS = tuple(sorted(FAST_MATH))


def _typed(function: Callable, result: Callable[..., types.Type | None]) -> None:
    """Tell numba the type of `function(*arguments)`; None where it doesn't take such arguments."""

    @type_callable(function)
    def typing(_context: Any) -> Callable:
        return result


def _lowered(function: Callable, *arguments: Any) -> Callable:
    """Decorate `lower(builder, *values)`, which builds the LLVM code of `function` for these argument types."""

    def register(lower: Callable) -> Callable:
        @lower_builtin(function, *arguments)
        def code(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
            return lower(builder, *values)

        return lower

    return register


def _llvm(builder: Any, name: str, result: ir.Type, *values: Any) -> Any:
    """A call of LLVM's own function `name`."""
    kind = ir.FunctionType(result, [value.type for value in values])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)


def _suffix(vector: ir.VectorType) -> str:
    """How LLVM spells a vector type in the name of a function."""
    kinds = {ir.FloatType(): "f32", ir.DoubleType(): "f64", ir.IntType(64): "i64"}
    return f"v{vector.count}{kinds[vector.element]}"


def _broadcast(builder: Any, value: Any, count: int = LANES) -> Any:
    vector = ir.VectorType(value.type, count)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), count), [0] * count)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


def _same(*arguments: types.Type) -> types.Type | None:
    """The one floating type of all arguments."""
    return arguments[0] if isinstance(arguments[0], LanesType) and set(arguments) == {arguments[0]} else None


def _same_or_number(a: types.Type, b: types.Type) -> types.Type | None:
    """The type of the lanes where both arguments are alike or one is a single number."""
    number = (types.Float, types.Integer)
    if isinstance(a, LanesType) and isinstance(b, number):
        return a
    if isinstance(b, LanesType) and isinstance(a, number):
        return b
    return _same(a, b)


def _masks(*arguments: types.Type) -> types.Type | None:
    return arguments[0] if isinstance(arguments[0], MaskType) and set(arguments) == {arguments[0]} else None


def _mask_for(kind: types.Type | None) -> types.Type | None:
    return MaskType(kind.count) if isinstance(kind, LanesType) else None


def _arithmetic() -> None:
    """+ - * / and < <= > >= between lanes, or lanes and a number, and & | ~ between masks: NumPy has them already."""
    binary = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
    binary |= {operator.iadd: "fadd", operator.isub: "fsub", operator.imul: "fmul"}  # which are the same for numbers
    comparisons = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">="}
    for function, name in binary.items():
        _typed(function, lambda a, b: _same_or_number(a, b))
        _lower_mixed(function, lambda b, x, y, name=name: getattr(b, name)(x, y, flags=FREEDOMS))
    for function, sign in comparisons.items():
        _typed(function, lambda a, b: _mask_for(_same_or_number(a, b)))
        _lower_mixed(function, lambda b, x, y, sign=sign: b.fcmp_ordered(sign, x, y))
    for function, name in {operator.and_: "and_", operator.or_: "or_"}.items():
        _typed(function, lambda a, b: _masks(a, b))
        _lowered(function, MaskType, MaskType)(lambda b, x, y, name=name: getattr(b, name)(x, y))
    _typed(operator.invert, lambda a: _masks(a))
    _lowered(operator.invert, MaskType)(lambda b, x: b.not_(x))
    _typed(operator.neg, lambda a: _same(a))
    _lowered(operator.neg, LanesType)(lambda b, x: b.fneg(x))


def _lower_mixed(function: Callable, lower: Callable) -> None:
    """For lanes and lanes, lanes and a number, a number and lanes."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        like = next(kind for kind in signature.args if isinstance(kind, LanesType))
        lanes = [
            value
            if isinstance(kind, LanesType)
            else _broadcast(builder, context.cast(builder, value, kind, like.dtype), like.count)
            for kind, value in zip(signature.args, values, strict=True)
        ]
        return lower(builder, *lanes)

    lower_builtin(function, LanesType, LanesType)(code)
    for number in (types.Float, types.Integer):
        lower_builtin(function, LanesType, number)(code)
        lower_builtin(function, number, LanesType)(code)


_arithmetic()


def spread(value: Any) -> Lanes:
    """One number in all lanes."""
    return np.full(LANES, value)


_typed(spread, lambda value: LanesType(value) if isinstance(value, types.Float) else None)
for _number in REALS:
    _lowered(spread, _number)(lambda b, value: _broadcast(b, value))


def filled(value: Any, like: Lanes) -> Lanes:
    """One number in as many lanes, and of the type, of another `Lanes`."""
    return np.full_like(like, value)


_typed(filled, lambda value, like: like if isinstance(like, LanesType) else None)


@lower_builtin(filled, types.Number, LanesType)
def _lower_filled(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    like = signature.args[1]
    return _broadcast(builder, context.cast(builder, values[0], signature.args[0], like.dtype), like.count)


def fma(a: Lanes, b: Lanes, c: Lanes) -> Lanes:
    """a b + c, rounded once."""
    return a * b + c


def minimum(a: Lanes, b: Lanes) -> Lanes:
    """The smaller; `b` where either is NaN."""
    return np.where(a < b, a, b)


def maximum(a: Lanes, b: Lanes) -> Lanes:
    """The larger; `b` where either is NaN."""
    return np.where(a > b, a, b)


def square_root(a: Lanes) -> Lanes:
    """√a."""
    return np.sqrt(a)


def negative(a: Lanes) -> Lanes:
    """-|a|."""
    return -np.abs(a)


def select(mask: Mask, a: Lanes, b: Lanes) -> Lanes:
    """`a` where the mask is set, else `b`."""
    return np.where(mask, a, b)


def rounder(a: Lanes) -> Any:
    """What, added to a number of that type, rounds it to a whole one: 1.5 times the reach of its mantissa."""
    return a.dtype.type(1.5 * 2 ** np.finfo(a.dtype).nmant)


def times_power_of_two(a: Lanes, rounded: Lanes) -> Lanes:
    """a 2ⁿ, where `rounded` is n + `rounder`: its last bits, n, are added to the exponent of `a`."""
    return np.ldexp(a, (rounded - rounder(a)).astype(np.int32))


_typed(fma, lambda a, b, c: _same(a, b, c))
_typed(minimum, lambda a, b: _same(a, b))
_typed(maximum, lambda a, b: _same(a, b))
_typed(square_root, lambda a: _same(a))
_typed(negative, lambda a: _same(a))
_typed(select, lambda mask, a, b: _same(a, b) if _mask_for(a) == mask else None)
_typed(times_power_of_two, lambda a, rounded: _same(a, rounded))
_typed(rounder, lambda a: a.dtype if isinstance(a, LanesType) else None)


def converted(a: Lanes, like: np.ndarray) -> Lanes:
    """The same numbers in the dtype of an array."""
    return a.astype(like.dtype)


def exponent_of(a: Lanes) -> Lanes:
    """⌊log2 a⌋ of positive normal numbers."""
    return (np.frexp(a)[1] - 1).astype(a.dtype)


def mantissa_of(a: Lanes) -> Lanes:
    """a / 2^exponent_of(a), in [1, 2)."""
    return 2 * np.frexp(a)[0]


_typed(exponent_of, lambda a: _same(a))
_typed(mantissa_of, lambda a: _same(a))
_typed(
    converted, lambda a, like: LanesType(like.dtype, a.count) if _same(a) and isinstance(like, types.Array) else None
)


def _layout(vector: ir.VectorType) -> tuple[ir.VectorType, Callable[[int], ir.Constant], int, int]:
    """Of a vector of floats: that of integers as wide, how to write a constant of it, bias and place of exponents."""
    bits, bias, place = (32, 127, 23) if vector.element == ir.FloatType() else (64, 1023, 52)
    integers = ir.VectorType(ir.IntType(bits), vector.count)
    return integers, lambda value: ir.Constant(integers, [value] * vector.count), bias, place


def _exponent(builder: Any, a: Any) -> Any:
    integers, constant, bias, place = _layout(a.type)
    exponent = builder.lshr(builder.bitcast(a, integers), constant(place))
    return builder.sitofp(builder.sub(exponent, constant(bias)), a.type)


def _mantissa(builder: Any, a: Any) -> Any:
    integers, constant, bias, place = _layout(a.type)
    bits = builder.and_(builder.bitcast(a, integers), constant((1 << place) - 1))
    return builder.bitcast(builder.or_(bits, constant(bias << place)), a.type)


def _times_power(builder: Any, a: Any, rounded: Any) -> Any:
    integers, constant, _, place = _layout(a.type)
    exponents = builder.shl(builder.bitcast(rounded, integers), constant(place))
    return builder.bitcast(builder.add(builder.bitcast(a, integers), exponents), a.type)


def _with_sign(builder: Any, a: Any) -> Any:
    integers, constant, _, place = _layout(a.type)
    sign = constant(1 << (31 if place == 23 else 63))
    return builder.bitcast(builder.or_(builder.bitcast(a, integers), sign), a.type)


@lower_builtin(rounder, LanesType)
def _lower_rounder(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    place = _layout(values[0].type)[3]
    return ir.Constant(context.get_data_type(signature.return_type), 1.5 * 2**place)


@lower_builtin(converted, LanesType, types.Array)
def _lower_converted(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    vector = ir.VectorType(context.get_data_type(signature.return_type.dtype), values[0].type.count)
    if vector == values[0].type:
        return values[0]
    return (builder.fpext if vector.element == ir.DoubleType() else builder.fptrunc)(values[0], vector)


_lowered(fma, LanesType, LanesType, LanesType)(
    lambda b, x, y, z: _llvm(b, f"llvm.fma.{_suffix(x.type)}", x.type, x, y, z)
)
_lowered(minimum, LanesType, LanesType)(lambda b, x, y: b.select(b.fcmp_ordered("<", x, y), x, y))
_lowered(maximum, LanesType, LanesType)(lambda b, x, y: b.select(b.fcmp_ordered(">", x, y), x, y))
_lowered(square_root, LanesType)(lambda b, x: _llvm(b, f"llvm.sqrt.{_suffix(x.type)}", x.type, x))
_lowered(negative, LanesType)(_with_sign)
_lowered(select, MaskType, LanesType, LanesType)(lambda b, mask, x, y: b.select(mask, x, y))
_lowered(times_power_of_two, LanesType, LanesType)(_times_power)
_lowered(exponent_of, LanesType)(_exponent)
_lowered(mantissa_of, LanesType)(_mantissa)


def pair(a: Lanes, b: Lanes) -> Lanes:
    """Both side by side; every operation above takes twice or four times as many lanes too. One long chain of
    operations leaves most of a core idle, chains side by side fill it."""
    return np.concatenate([a, b])


def first_of(pair_: Lanes) -> Lanes:
    """The first half of a pair, of lanes or masks."""
    return pair_[: len(pair_) // 2]


def second_of(pair_: Lanes) -> Lanes:
    """The second half of a pair, of lanes or masks."""
    return pair_[len(pair_) // 2 :]


def _half_of(pair_: types.Type) -> types.Type | None:
    if isinstance(pair_, LanesType):
        return LanesType(pair_.dtype, pair_.count // 2)
    return MaskType(pair_.count // 2) if isinstance(pair_, MaskType) else None


def _shuffled(builder: Any, a: Any, b: Any, lanes: Sequence[int]) -> Any:
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes)))


_typed(pair, lambda a, b: LanesType(a.dtype, 2 * a.count) if _same(a, b) else None)
_typed(first_of, lambda pair_: _half_of(pair_))
_typed(second_of, lambda pair_: _half_of(pair_))
_lowered(pair, LanesType, LanesType)(lambda b, x, y: _shuffled(b, x, y, range(2 * x.type.count)))
for _either in (LanesType, MaskType):
    _lowered(first_of, _either)(lambda b, x: _shuffled(b, x, x, range(x.type.count // 2)))
    _lowered(second_of, _either)(lambda b, x: _shuffled(b, x, x, range(x.type.count // 2, x.type.count)))


def bits_of(mask: Mask) -> Any:
    """The mask as a number: lane 0 is bit 0."""
    return int(np.dot(mask, 1 << np.arange(LANES)))


_typed(bits_of, lambda mask: types.uint64 if mask == MASK else None)
_lowered(bits_of, MASK)(lambda b, mask: b.zext(b.bitcast(mask, ir.IntType(LANES)), ir.IntType(64)))


def lowest_bit(bits: Index) -> Any:
    """The place of the lowest set bit of a number that is not 0."""
    return (int(bits) & -int(bits)).bit_length() - 1


_typed(lowest_bit, lambda bits: types.uint64 if bits == types.uint64 else None)
_lowered(lowest_bit, types.uint64)(lambda b, bits: b.cttz(bits, ir.Constant(ir.IntType(1), 1)))


def _is_array(array: Any, ndim: int) -> bool:
    shaped = isinstance(array, types.Array) and array.ndim == ndim and array.layout == "C"
    return shaped and array.dtype in REALS


def _vector_at(context: Any, builder: Any, signature: Any, values: Any) -> tuple[Any, int]:
    """Pointer to 16 numbers of the first argument, an array, at the index that is the second; its alignment."""
    kind = signature.args[0]
    data = context.make_array(kind)(context, builder, values[0]).data
    place = builder.gep(data, [context.cast(builder, values[1], signature.args[1], types.intp)])
    vector = ir.VectorType(context.get_data_type(kind.dtype), LANES)
    return builder.bitcast(place, vector.as_pointer()), kind.dtype.bitwidth // 8


def load(array: np.ndarray, start: Index) -> Lanes:
    """16 consecutive numbers of an array [n]."""
    return array[int(start) : int(start) + LANES].copy()


def store(array: np.ndarray, start: Index, lanes: Lanes) -> None:
    """Write 16 consecutive numbers of an array [n]."""
    array[int(start) : int(start) + LANES] = lanes


def load_or(array: np.ndarray, start: Index, otherwise: Lanes) -> Lanes:
    """The numbers of an array [n] from `start`; `otherwise` past its end."""
    found = array[int(start) : int(start) + LANES]
    return np.concatenate([found, otherwise[len(found) :]])


def load_triples(array: np.ndarray, first_row: Index) -> tuple[Lanes, Lanes, Lanes]:
    """The columns of 16 rows of an array [n, 3]; 0 past its rows."""
    found = array[int(first_row) :][:LANES]
    x, y, z = np.concatenate([found, np.zeros((LANES - len(found), 3), array.dtype)]).T.copy()
    return x, y, z


def load_four_columns(array: np.ndarray, first_row: Index, first_column: Index) -> tuple[Lanes, ...]:
    """4 of the columns, which must be there, of 16 rows of an array [n, m]; past the end of the rows the last counts
    again."""
    rows = np.minimum(np.arange(int(first_row), int(first_row) + LANES), len(array) - 1)
    return tuple(array[rows, int(first_column) : int(first_column) + 4].T.copy())


def load_columns(array: np.ndarray, first_row: Index) -> tuple[Lanes, ...]:
    """The columns of 16 rows of an array [n, 16]; past the end of the rows the last counts again."""
    return tuple(column for first in range(0, LANES, 4) for column in load_four_columns(array, first_row, first))


def load_columns_of(array: np.ndarray, rows: np.ndarray, start: Index) -> tuple[Lanes, ...]:
    """The 16 columns of an array [n, 16], at the rows that 16 numbers of `rows` [m] name from `start`; past the end of
    `rows` its last number counts again."""
    found = rows[np.minimum(np.arange(int(start), int(start) + LANES), len(rows) - 1)]
    return tuple(array[found].T.copy())


def store_columns(array: np.ndarray, first_row: Index, first_column: Index, columns: tuple[Lanes, ...]) -> None:
    """Write up to 16 columns, and 0 for those that lack, into 16 rows of an array [n, m]; what is past its rows and
    columns is dropped."""
    block = array[int(first_row) :, int(first_column) :][:LANES, :LANES]
    block[:] = _sixteen(columns).T[: block.shape[0], : block.shape[1]]


def store_rows(array: np.ndarray, first_row: Index, columns: tuple[Lanes, ...]) -> None:
    """Write up to 16 columns, and 0 for those that lack, into 16 rows, which must be there, of an array [n, 16]."""
    array[int(first_row) : int(first_row) + LANES] = _sixteen(columns).T


def store_whole_numbers(array: np.ndarray, first_row: Index, columns: tuple[Lanes, ...]) -> None:
    """Write 4 columns of numbers in [0, 65535], cut off at the point, into 16 rows of an array [n, 4] of uint16; rows
    past its end are dropped."""
    rows = array[int(first_row) :][:LANES]
    rows[:] = np.stack(columns, axis=1)[: len(rows)]


def sums_of(columns: tuple[Lanes, ...]) -> Lanes:
    """The sum of each of up to 16 `Lanes`, in the lane of its number; 0 in the others."""
    return _sixteen(columns).sum(axis=1)


def _sixteen(columns: tuple[Lanes, ...]) -> np.ndarray:
    """[16, 16] columns as rows, filled up with zeros."""
    return np.stack([*columns, *[np.zeros_like(columns[0])] * (LANES - len(columns))])


def _filled_up(builder: Any, columns: Any) -> list[Any]:
    """The vectors of a tuple, and vectors of zeros up to 16."""
    vectors = [builder.extract_value(columns, k) for k in range(len(columns.type))]
    return vectors + [ir.Constant(vectors[0].type, [0.0] * LANES)] * (LANES - len(vectors))


@type_callable(sums_of)
def _type_sums_of(_context: Any) -> Callable:
    return lambda columns: columns.dtype if isinstance(columns, types.UniTuple) else None


@lower_builtin(sums_of, types.UniTuple)
def _lower_sums_of(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    vectors = _filled_up(builder, values[0])
    lower, upper = ([lane for k in range(start, start + 8) for lane in (k, LANES + k)] for start in (0, 8))
    while len(vectors) > 1:  # two vectors of partial sums become one, whose neighbours belong to one and the other
        pairs = [(vectors[k], vectors[k + len(vectors) // 2]) for k in range(len(vectors) // 2)]
        vectors = [
            builder.fadd(_shuffled(builder, a, b, lower), _shuffled(builder, a, b, upper), flags=FREEDOMS)
            for a, b in pairs
        ]
    return vectors[0]


@type_callable(load)
def _type_load(_context: Any) -> Callable:
    return lambda array, start: LanesType(array.dtype) if _is_array(array, 1) else None


@type_callable(store)
def _type_store(_context: Any) -> Callable:
    return lambda array, start, lanes: types.none if _is_array(array, 1) and LanesType(array.dtype) == lanes else None


@type_callable(load_or)
def _type_load_or(_context: Any) -> Callable:
    return lambda array, start, otherwise: otherwise if _is_array(array, 1) else None


@type_callable(load_triples)
def _type_load_triples(_context: Any) -> Callable:
    return lambda array, row: types.UniTuple(LanesType(array.dtype), 3) if _is_array(array, 2) else None


@type_callable(load_four_columns)
def _type_load_four_columns(_context: Any) -> Callable:
    return lambda array, row, column: types.UniTuple(LanesType(array.dtype), 4) if _is_array(array, 2) else None


@type_callable(load_columns)
def _type_load_columns(_context: Any) -> Callable:
    return lambda array, row: types.UniTuple(LanesType(array.dtype), LANES) if _is_array(array, 2) else None


@type_callable(load_columns_of)
def _type_load_columns_of(_context: Any) -> Callable:
    return lambda array, rows, start: types.UniTuple(LanesType(array.dtype), LANES) if _is_array(array, 2) else None


@type_callable(store_columns)
def _type_store_columns(_context: Any) -> Callable:
    return lambda array, row, column, columns: types.none if _is_array(array, 2) else None


@lower_builtin(load, types.Array, types.Integer)
def _lower_load(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    place, alignment = _vector_at(context, builder, signature, values)
    return builder.load(place, align=alignment)


@lower_builtin(store, types.Array, types.Integer, LanesType)
def _lower_store(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    place, alignment = _vector_at(context, builder, signature, values)
    builder.store(values[2], place, align=alignment)
    return context.get_dummy_value()


def _first(builder: Any, count: Any) -> Any:
    """The mask of the first `count` lanes, an i64 that may be negative or above 16."""
    integers = ir.VectorType(ir.IntType(64), LANES)
    return builder.icmp_signed("<", ir.Constant(integers, list(range(LANES))), _broadcast(builder, count))


def _masked_load(builder: Any, place: Any, alignment: int, mask: Any, otherwise: Any) -> Any:
    name = f"llvm.masked.load.{_suffix(otherwise.type)}.p0"
    return _llvm(builder, name, otherwise.type, place, ir.Constant(ir.IntType(32), alignment), mask, otherwise)


def _masked_store(builder: Any, place: Any, alignment: int, mask: Any, lanes: Any) -> None:
    name = f"llvm.masked.store.{_suffix(lanes.type)}.p0"
    _llvm(builder, name, ir.VoidType(), lanes, place, ir.Constant(ir.IntType(32), alignment), mask)


@lower_builtin(load_or, types.Array, types.Integer, LanesType)
def _lower_load_or(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    place, alignment = _vector_at(context, builder, signature, values)
    array = context.make_array(signature.args[0])(context, builder, values[0])
    start = context.cast(builder, values[1], signature.args[1], types.intp)
    count = builder.sub(builder.extract_value(array.shape, 0), start)
    return _masked_load(builder, place, alignment, _first(builder, count), values[2])


def _transposed(builder: Any, vectors: list[Any]) -> list[Any]:
    """16 vectors as the columns of a matrix to those that are its rows: four rounds of interleaving."""
    lower = [lane for k in range(LANES // 2) for lane in (k, LANES + k)]
    upper = [lane for k in range(LANES // 2, LANES) for lane in (k, LANES + k)]
    low, high = (ir.Constant(ir.VectorType(ir.IntType(32), LANES), lanes) for lanes in (lower, upper))
    for _ in range(4):
        pairs = [(vectors[k], vectors[k + LANES // 2]) for k in range(LANES // 2)]
        vectors = [builder.shuffle_vector(a, b, mask) for a, b in pairs for mask in (low, high)]
    return vectors


def _rows(context: Any, builder: Any, kind: Any, array: Any, first_row: Any, first_column: Any) -> tuple[Any, Any, Any]:
    """Of an array [n, m]: pointers to the 16 rows, the number of rows and that of columns from there."""
    array = context.make_array(kind)(context, builder, array)
    count, width = (builder.extract_value(array.shape, axis) for axis in (0, 1))
    start = builder.add(builder.mul(first_row, width), first_column)
    vector = ir.VectorType(context.get_data_type(kind.dtype), LANES).as_pointer()
    places = []
    for row in range(LANES):
        offset = builder.add(start, builder.mul(width, ir.Constant(ir.IntType(64), row)))
        places.append(builder.bitcast(builder.gep(array.data, [offset]), vector))
    return places, builder.sub(count, first_row), builder.sub(width, first_column)


@lower_builtin(load_triples, types.Array, types.Integer)
def _lower_load_triples(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    """48 numbers in a row; a column takes two shuffles."""
    kind = signature.args[0]
    array = context.make_array(kind)(context, builder, values[0])
    row = context.cast(builder, values[1], signature.args[1], types.intp)
    three = ir.Constant(ir.IntType(64), 3)
    left = builder.mul(builder.sub(builder.extract_value(array.shape, 0), row), three)
    vector = ir.VectorType(context.get_data_type(kind.dtype), LANES)
    v = []
    for first in range(0, 3 * LANES, LANES):
        offset = builder.add(builder.mul(row, three), ir.Constant(ir.IntType(64), first))
        place = builder.bitcast(builder.gep(array.data, [offset]), vector.as_pointer())
        some = _first(builder, builder.sub(left, ir.Constant(ir.IntType(64), first)))
        zeros = ir.Constant(vector, [0.0] * LANES)
        v.append(_masked_load(builder, place, kind.dtype.bitwidth // 8, some, zeros))
    columns = []
    for column in range(3):
        wanted = range(column, 3 * LANES, 3)
        two = _shuffled(builder, v[0], v[1], [place % (2 * LANES) for place in wanted])
        ends = [k if place < 2 * LANES else place - LANES for k, place in enumerate(wanted)]
        columns.append(_shuffled(builder, two, v[2], ends))
    return context.make_tuple(builder, signature.return_type, columns)


@lower_builtin(load_four_columns, types.Array, types.Integer, types.Integer)
def _lower_load_four_columns(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    places, real = _clamped_rows(context, builder, signature.args[0], values[0], signature.args[1], values[1])
    column = context.cast(builder, values[2], signature.args[2], types.intp)
    columns = _four_columns(builder, places, real, column)
    return context.make_tuple(builder, signature.return_type, columns)


@lower_builtin(load_columns, types.Array, types.Integer)
def _lower_load_columns(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    places, real = _clamped_rows(context, builder, signature.args[0], values[0], signature.args[1], values[1])
    return context.make_tuple(builder, signature.return_type, _sixteen_columns(builder, places, real))


def _clamped_rows(
    context: Any, builder: Any, kind: Any, array: Any, row_kind: Any, first_row: Any
) -> tuple[list[Any], ir.Type]:
    """Pointers to 16 rows of an array [n, m], to the last one where there are no more; what they point to."""
    array = context.make_array(kind)(context, builder, array)
    count, width = (builder.extract_value(array.shape, axis) for axis in (0, 1))
    last = builder.sub(count, ir.Constant(ir.IntType(64), 1))
    first = context.cast(builder, first_row, row_kind, types.intp)
    places = []
    for k in range(LANES):
        row = builder.add(first, ir.Constant(ir.IntType(64), k))
        row = builder.select(builder.icmp_signed("<", row, last), row, last)
        places.append(builder.gep(array.data, [builder.mul(row, width)]))
    return places, context.get_data_type(kind.dtype)


@lower_builtin(load_columns_of, types.Array, types.Array, types.Integer)
def _lower_load_columns_of(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    kind, row_kind = signature.args[:2]
    data = context.make_array(kind)(context, builder, values[0]).data
    rows = context.make_array(row_kind)(context, builder, values[1])
    start = context.cast(builder, values[2], signature.args[2], types.intp)
    last = builder.sub(builder.extract_value(rows.shape, 0), ir.Constant(ir.IntType(64), 1))
    places = []
    for k in range(LANES):
        entry = builder.add(start, ir.Constant(ir.IntType(64), k))
        entry = builder.select(builder.icmp_signed("<", entry, last), entry, last)
        row = context.cast(builder, builder.load(builder.gep(rows.data, [entry])), row_kind.dtype, types.intp)
        places.append(builder.gep(data, [builder.mul(row, ir.Constant(ir.IntType(64), LANES))]))
    real = context.get_data_type(kind.dtype)
    return context.make_tuple(builder, signature.return_type, _sixteen_columns(builder, places, real))


def _sixteen_columns(builder: Any, places: list[Any], real: ir.Type) -> list[Any]:
    firsts = [ir.Constant(ir.IntType(64), first) for first in range(0, LANES, 4)]
    return [column for first in firsts for column in _four_columns(builder, places, real, first)]


def _four_columns(builder: Any, places: list[Any], real: ir.Type, first: Any) -> list[Any]:
    """Columns `first` to `first` + 3 of the 16 rows that begin at `places`. Groups of four rows lie side by side, so
    that only the four by four within a group are turned round."""
    quarter, size = ir.VectorType(real, 4), 4 if real == ir.FloatType() else 8
    pieces = []
    for place in places:
        piece = builder.gep(place, [first])
        pieces.append(builder.load(builder.bitcast(piece, quarter.as_pointer()), align=size))
    v = []
    for k in range(4):
        low, high = (_shuffled(builder, pieces[k + j], pieces[k + j + 4], range(8)) for j in (0, 8))
        v.append(_shuffled(builder, low, high, range(16)))
    low, high = ([lane for q in range(k, LANES, 4) for lane in (q, LANES + q, q + 1, LANES + q + 1)] for k in (0, 2))
    v = [_shuffled(builder, a, b, lanes) for lanes in (low, high) for a, b in (v[:2], v[2:])]
    low, high = ([lane for q in range(k, LANES, 4) for lane in (q, q + 1, LANES + q, LANES + q + 1)] for k in (0, 2))
    return [_shuffled(builder, a, b, lanes) for a, b in (v[:2], v[2:]) for lanes in (low, high)]


@lower_builtin(store_columns, types.Array, types.Integer, types.Integer, types.UniTuple)
def _lower_store_columns(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    kind = signature.args[0]
    row, column = (
        context.cast(builder, v, t, types.intp) for v, t in zip(values[1:3], signature.args[1:3], strict=True)
    )
    places, count, width = _rows(context, builder, kind, values[0], row, column)
    rows = _transposed(builder, _filled_up(builder, values[3]))
    some = _first(builder, width)
    for k, (place, lanes) in enumerate(zip(places, rows, strict=True)):
        with builder.if_then(builder.icmp_signed("<", ir.Constant(ir.IntType(64), k), count)):
            _masked_store(builder, place, kind.dtype.bitwidth // 8, some, lanes)
    return context.get_dummy_value()


@type_callable(store_rows)
def _type_store_rows(_context: Any) -> Callable:
    return lambda array, row, columns: types.none if _is_array(array, 2) else None


@lower_builtin(store_rows, types.Array, types.Integer, types.UniTuple)
def _lower_store_rows(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    kind = signature.args[0]
    array = context.make_array(kind)(context, builder, values[0])
    row = context.cast(builder, values[1], signature.args[1], types.intp)
    place = builder.gep(array.data, [builder.mul(row, ir.Constant(ir.IntType(64), LANES))])
    vector = ir.VectorType(context.get_data_type(kind.dtype), LANES).as_pointer()
    for k, lanes in enumerate(_transposed(builder, _filled_up(builder, values[2]))):
        there = builder.gep(place, [ir.Constant(ir.IntType(64), LANES * k)])
        builder.store(lanes, builder.bitcast(there, vector), align=kind.dtype.bitwidth // 8)
    return context.get_dummy_value()


@type_callable(store_whole_numbers)
def _type_store_whole_numbers(_context: Any) -> Callable:
    kind = types.Array(types.uint16, 2, "C")
    return lambda array, row, columns: types.none if array == kind and len(columns) == 4 else None


@lower_builtin(store_whole_numbers, types.Array, types.Integer, types.UniTuple)
def _lower_store_whole_numbers(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    """A row is one number of 64 bits, its first column the lowest: what numba runs on stores those first."""
    array = context.make_array(signature.args[0])(context, builder, values[0])
    row = context.cast(builder, values[1], signature.args[1], types.intp)
    half, whole = (ir.VectorType(ir.IntType(bits), LANES) for bits in (32, 64))
    columns = [builder.zext(builder.fptosi(v, half), whole) for v in cgutils.unpack_tuple(builder, values[2])]
    rows = columns[0]
    for k, column in enumerate(columns[1:], start=1):
        rows = builder.or_(rows, builder.shl(column, ir.Constant(whole, [16 * k] * LANES)))
    place = builder.gep(array.data, [builder.mul(row, ir.Constant(ir.IntType(64), len(columns)))])
    exists = _first(builder, builder.sub(builder.extract_value(array.shape, 0), row))
    _masked_store(builder, builder.bitcast(place, whole.as_pointer()), 2, exists, rows)
    return context.get_dummy_value()


def store_square(array: np.ndarray, start: Index, stride: Index, lanes: Lanes) -> None:
    """Write 4 × 4 numbers into an array [n]: 4 from `start`, the next 4 `stride` further, and so on."""
    for row, numbers in enumerate(np.reshape(lanes, (4, 4))):
        array[int(start) + row * int(stride) :][:4] = numbers


def store_square_of_triples(array: np.ndarray, start: Index, stride: Index, a: Lanes, b: Lanes, c: Lanes) -> None:
    """Write 4 × 4 triples (a, b, c) into an array [n], 4 of them from `start`, the next 4 `stride` further."""
    for row, triples in enumerate(np.stack([a, b, c], axis=1).reshape(4, 12)):
        array[int(start) + row * int(stride) :][:12] = triples


@type_callable(store_square)
def _type_store_square(_context: Any) -> Callable:
    return lambda array, start, stride, lanes: types.none if _is_array(array, 1) else None


@type_callable(store_square_of_triples)
def _type_store_square_of_triples(_context: Any) -> Callable:
    return lambda array, start, stride, a, b, c: types.none if _is_array(array, 1) and _same(a, b, c) else None


def _store_pieces(
    context: Any, builder: Any, signature: Any, values: Any, pieces: list[Any], write: Callable | None = None
) -> Any:
    """Write vectors into the array, the first argument, at the second, each the third further than the one before."""
    kind = signature.args[0]
    data = context.make_array(kind)(context, builder, values[0]).data
    start, stride = (
        context.cast(builder, v, t, types.intp) for v, t in zip(values[1:3], signature.args[1:3], strict=True)
    )
    for piece in pieces:
        place = builder.bitcast(builder.gep(data, [start]), piece.type.as_pointer())
        if write:
            write(place, piece)
        else:
            builder.store(piece, place, align=kind.dtype.bitwidth // 8)
        start = builder.add(start, stride)
    return context.get_dummy_value()


@lower_builtin(store_square, types.Array, types.Integer, types.Integer, LanesType)
def _lower_store_square(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    lanes = values[3]
    rows = [_shuffled(builder, lanes, lanes, range(4 * row, 4 * row + 4)) for row in range(4)]
    return _store_pieces(context, builder, signature, values, rows)


@lower_builtin(store_square_of_triples, types.Array, types.Integer, types.Integer, LanesType, LanesType, LanesType)
def _lower_store_square_of_triples(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    kind = signature.args[0]
    mask = _first(builder, ir.Constant(ir.IntType(64), 12))
    rows = []
    for row in range(4):
        wanted = [(pixel, channel) for pixel in range(4 * row, 4 * row + 4) for channel in range(3)]
        # two sources a shuffle: first and second value, then those and the third; the last 4 lanes are not written
        two = [channel * LANES + pixel if channel < 2 else 0 for pixel, channel in wanted]
        three = [place if channel < 2 else LANES + pixel for place, (pixel, channel) in enumerate(wanted)]
        some = _shuffled(builder, values[3], values[4], [*two, 0, 0, 0, 0])
        rows.append(_shuffled(builder, some, values[5], [*three, 0, 0, 0, 0]))

    def write(place: Any, row: Any) -> None:
        _masked_store(builder, place, kind.dtype.bitwidth // 8, mask, row)

    return _store_pieces(context, builder, signature, values, rows, write)


def prefetch(array: np.ndarray, place: Index) -> None:
    """Have the cache line of an element of an array [n] fetched meanwhile; nothing without the compiler."""


@type_callable(prefetch)
def _type_prefetch(_context: Any) -> Callable:
    return lambda array, place: types.none


@lower_builtin(prefetch, types.Array, types.Integer)
def _lower_prefetch(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, values[0]).data
    place = builder.gep(data, [context.cast(builder, values[1], signature.args[1], types.intp)])
    byte = builder.bitcast(place, ir.IntType(8).as_pointer())
    read, everywhere, data_cache = (ir.Constant(ir.IntType(32), value) for value in (0, 3, 1))
    _llvm(builder, "llvm.prefetch.p0", ir.VoidType(), byte, read, everywhere, data_cache)
    return context.get_dummy_value()
