"""Operations on SIMD vectors of 16 numbers, in which the rasterizer's inner loops are written.

In compiled kernels a `Vector` is an LLVM vector of 16 float32 or float64, and a `Mask` one of 16 bits: on a CPU with
AVX-512 a float32 operation is one instruction, elsewhere LLVM splits it. LLVM doesn't vectorize these loops by itself:
scalar ones take 3x the time. Without the compiler the same kernels run on NumPy arrays [16], by the functions' bodies.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import lower_builtin

from msdgs_serve.rasterizer.simd.types import (
    FREEDOMS,
    MASK,
    NUM_LANES,
    REALS,
    Index,
    Mask,
    MaskType,
    Vector,
    VectorType,
    broadcast,
    llvm,
    lowered,
    same,
    shuffled,
    suffix,
    typed,
)


def _same_or_number(a: types.Type, b: types.Type) -> types.Type | None:
    """Return the vector type if both arguments have it or one of them is a single number."""
    number = (types.Float, types.Integer)
    if isinstance(a, VectorType) and isinstance(b, number):
        return a
    if isinstance(b, VectorType) and isinstance(a, number):
        return b
    return same(a, b)


def _masks(*arguments: types.Type) -> types.Type | None:
    return arguments[0] if isinstance(arguments[0], MaskType) and set(arguments) == {arguments[0]} else None


def _mask_for(kind: types.Type | None) -> types.Type | None:
    return MaskType(kind.count) if isinstance(kind, VectorType) else None


def _arithmetic() -> None:
    """Define + - * / < <= > >= of vectors, or of a vector and a number, and & | ~ of masks; NumPy arrays have them."""
    binary = {operator.add: "fadd", operator.sub: "fsub", operator.mul: "fmul", operator.truediv: "fdiv"}
    binary |= {
        operator.iadd: "fadd",
        operator.isub: "fsub",
        operator.imul: "fmul",
    }  # in place, which is the same for numbers
    comparisons = {operator.lt: "<", operator.le: "<=", operator.gt: ">", operator.ge: ">="}
    for function, name in binary.items():
        typed(function, lambda a, b: _same_or_number(a, b))
        _lower_mixed(function, lambda b, x, y, name=name: getattr(b, name)(x, y, flags=FREEDOMS))
    for function, sign in comparisons.items():
        typed(function, lambda a, b: _mask_for(_same_or_number(a, b)))
        _lower_mixed(function, lambda b, x, y, sign=sign: b.fcmp_ordered(sign, x, y))
    for function, name in {operator.and_: "and_", operator.or_: "or_"}.items():
        typed(function, lambda a, b: _masks(a, b))
        lowered(function, MaskType, MaskType)(lambda b, x, y, name=name: getattr(b, name)(x, y))
    typed(operator.invert, lambda a: _masks(a))
    lowered(operator.invert, MaskType)(lambda b, x: b.not_(x))
    typed(operator.neg, lambda a: same(a))
    lowered(operator.neg, VectorType)(lambda b, x: b.fneg(x))


def _lower_mixed(function: Callable, lower: Callable) -> None:
    """Define an operation of two vectors, of a vector and a number, and of a number and a vector."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        like = next(kind for kind in signature.args if isinstance(kind, VectorType))
        vectors = [
            value
            if isinstance(kind, VectorType)
            else broadcast(builder, context.cast(builder, value, kind, like.dtype), like.count)
            for kind, value in zip(signature.args, values, strict=True)
        ]
        return lower(builder, *vectors)

    lower_builtin(function, VectorType, VectorType)(code)
    for number in (types.Float, types.Integer):
        lower_builtin(function, VectorType, number)(code)
        lower_builtin(function, number, VectorType)(code)


_arithmetic()


def spread(value: Any) -> Vector:
    """Return a vector with one number in all lanes."""
    return np.full(NUM_LANES, value)


typed(spread, lambda value: VectorType(value) if isinstance(value, types.Float) else None)
for _number in REALS:
    lowered(spread, _number)(lambda b, value: broadcast(b, value))


def filled(value: Any, like: Vector) -> Vector:
    """Return a vector of the type of `like` with one number in all lanes."""
    return np.full_like(like, value)


typed(filled, lambda value, like: like if isinstance(like, VectorType) else None)


@lower_builtin(filled, types.Number, VectorType)
def _lower_filled(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    like = signature.args[1]
    return broadcast(builder, context.cast(builder, values[0], signature.args[0], like.dtype), like.count)


def fma(a: Vector, b: Vector, c: Vector) -> Vector:
    """Return a b + c, rounded once."""
    return a * b + c


def minimum(a: Vector, b: Vector) -> Vector:
    """Return the smaller numbers; `b` if either is NaN."""
    return np.where(a < b, a, b)


def maximum(a: Vector, b: Vector) -> Vector:
    """Return the larger numbers; `b` if either is NaN."""
    return np.where(a > b, a, b)


def square_root(a: Vector) -> Vector:
    """Return √a."""
    return np.sqrt(a)


def negative(a: Vector) -> Vector:
    """Return -|a|."""
    return -np.abs(a)


def select(mask: Mask, a: Vector, b: Vector) -> Vector:
    """Return `a` in lanes where the mask is set, else `b`."""
    return np.where(mask, a, b)


def rounder(a: Vector) -> Any:
    """Return the number that, added to one of the type of `a`, rounds it to an integer: 1.5 × 2^mantissa bits."""
    return a.dtype.type(1.5 * 2 ** np.finfo(a.dtype).nmant)


def times_power_of_two(a: Vector, rounded: Vector) -> Vector:
    """Return a 2ⁿ for `rounded` = n + `rounder(a)`: its last bits, n, are added to the exponent of `a`."""
    return np.ldexp(a, (rounded - rounder(a)).astype(np.int32))


typed(fma, lambda a, b, c: same(a, b, c))
typed(minimum, lambda a, b: same(a, b))
typed(maximum, lambda a, b: same(a, b))
typed(square_root, lambda a: same(a))
typed(negative, lambda a: same(a))
typed(select, lambda mask, a, b: same(a, b) if _mask_for(a) == mask else None)
typed(times_power_of_two, lambda a, rounded: same(a, rounded))
typed(rounder, lambda a: a.dtype if isinstance(a, VectorType) else None)


def converted(a: Vector, like: np.ndarray) -> Vector:
    """Return the numbers in the dtype of the array `like`."""
    return a.astype(like.dtype)


def exponent_of(a: Vector) -> Vector:
    """Return ⌊log2 a⌋ of positive normal numbers."""
    return (np.frexp(a)[1] - 1).astype(a.dtype)


def mantissa_of(a: Vector) -> Vector:
    """Return a / 2^exponent_of(a), in [1, 2)."""
    return 2 * np.frexp(a)[0]


typed(exponent_of, lambda a: same(a))
typed(mantissa_of, lambda a: same(a))
typed(converted, lambda a, like: VectorType(like.dtype, a.count) if same(a) and isinstance(like, types.Array) else None)


def _layout(vector: ir.VectorType) -> tuple[ir.VectorType, Callable[[int], ir.Constant], int, int]:
    """Return, for a vector of floats, the integer vector type of equal width, a function that makes its constants, and
    the bias and bit position of the exponents."""
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


@lower_builtin(rounder, VectorType)
def _lower_rounder(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    place = _layout(values[0].type)[3]
    return ir.Constant(context.get_data_type(signature.return_type), 1.5 * 2**place)


@lower_builtin(converted, VectorType, types.Array)
def _lower_converted(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    vector = ir.VectorType(context.get_data_type(signature.return_type.dtype), values[0].type.count)
    if vector == values[0].type:
        return values[0]
    return (builder.fpext if vector.element == ir.DoubleType() else builder.fptrunc)(values[0], vector)


lowered(fma, VectorType, VectorType, VectorType)(
    lambda b, x, y, z: llvm(b, f"llvm.fma.{suffix(x.type)}", x.type, x, y, z)
)
lowered(minimum, VectorType, VectorType)(lambda b, x, y: b.select(b.fcmp_ordered("<", x, y), x, y))
lowered(maximum, VectorType, VectorType)(lambda b, x, y: b.select(b.fcmp_ordered(">", x, y), x, y))
lowered(square_root, VectorType)(lambda b, x: llvm(b, f"llvm.sqrt.{suffix(x.type)}", x.type, x))
lowered(negative, VectorType)(_with_sign)
lowered(select, MaskType, VectorType, VectorType)(lambda b, mask, x, y: b.select(mask, x, y))
lowered(times_power_of_two, VectorType, VectorType)(_times_power)
lowered(exponent_of, VectorType)(_exponent)
lowered(mantissa_of, VectorType)(_mantissa)


def pair(a: Vector, b: Vector) -> Vector:
    """Return both vectors as one of twice the size; the operations above take vectors of 32 and 64 lanes too. One long
    chain of dependent operations leaves most of a core idle, several independent chains fill it."""
    return np.concatenate([a, b])


def first_of(pair_: Vector) -> Vector:
    """Return the first half of a pair of vectors or masks."""
    return pair_[: len(pair_) // 2]


def second_of(pair_: Vector) -> Vector:
    """Return the second half of a pair of vectors or masks."""
    return pair_[len(pair_) // 2 :]


def _half_of(pair_: types.Type) -> types.Type | None:
    if isinstance(pair_, VectorType):
        return VectorType(pair_.dtype, pair_.count // 2)
    return MaskType(pair_.count // 2) if isinstance(pair_, MaskType) else None


typed(pair, lambda a, b: VectorType(a.dtype, 2 * a.count) if same(a, b) else None)
typed(first_of, lambda pair_: _half_of(pair_))
typed(second_of, lambda pair_: _half_of(pair_))
lowered(pair, VectorType, VectorType)(lambda b, x, y: shuffled(b, x, y, range(2 * x.type.count)))
for _either in (VectorType, MaskType):
    lowered(first_of, _either)(lambda b, x: shuffled(b, x, x, range(x.type.count // 2)))
    lowered(second_of, _either)(lambda b, x: shuffled(b, x, x, range(x.type.count // 2, x.type.count)))


def bits_of(mask: Mask) -> Any:
    """Return the mask as a number; lane 0 is bit 0."""
    return int(np.dot(mask, 1 << np.arange(NUM_LANES)))


typed(bits_of, lambda mask: types.uint64 if mask == MASK else None)
lowered(bits_of, MASK)(lambda b, mask: b.zext(b.bitcast(mask, ir.IntType(NUM_LANES)), ir.IntType(64)))


def lowest_bit(bits: Index) -> Any:
    """Return the position of the lowest set bit of a number that is not 0."""
    return (int(bits) & -int(bits)).bit_length() - 1


typed(lowest_bit, lambda bits: types.uint64 if bits == types.uint64 else None)
lowered(lowest_bit, types.uint64)(lambda b, bits: b.cttz(bits, ir.Constant(ir.IntType(1), 1)))


def sums_of(columns: tuple[Vector, ...]) -> Vector:
    """Return the sums of up to 16 vectors, each in the lane of its index; 0 in the other lanes."""
    return as_rows(columns).sum(axis=1)


def as_rows(columns: tuple[Vector, ...]) -> np.ndarray:
    """Return up to 16 vectors as rows of an array [16, 16], followed by zeros."""
    return np.stack([*columns, *[np.zeros_like(columns[0])] * (NUM_LANES - len(columns))])


def padded(builder: Any, columns: Any) -> list[Any]:
    """Return the vectors of a tuple, followed by vectors of zeros up to 16."""
    vectors = [builder.extract_value(columns, k) for k in range(len(columns.type))]
    return vectors + [ir.Constant(vectors[0].type, [0.0] * NUM_LANES)] * (NUM_LANES - len(vectors))


typed(sums_of, lambda columns: columns.dtype if isinstance(columns, types.UniTuple) else None)


@lower_builtin(sums_of, types.UniTuple)
def _lower_sums_of(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    vectors = padded(builder, values[0])
    lower, upper = ([lane for k in range(start, start + 8) for lane in (k, NUM_LANES + k)] for start in (0, 8))
    while len(vectors) > 1:  # adds neighbouring lanes of two vectors of partial sums into one vector
        pairs = [(vectors[k], vectors[k + len(vectors) // 2]) for k in range(len(vectors) // 2)]
        vectors = [
            builder.fadd(shuffled(builder, a, b, lower), shuffled(builder, a, b, upper), flags=FREEDOMS)
            for a, b in pairs
        ]
    return vectors[0]
