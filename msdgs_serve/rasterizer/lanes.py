"""Sixteen numbers at once: the lane-wise operations that the rasterizer's inner loops are written in.

In compiled kernels a `Lanes` is one LLVM vector of 16 float32 or float64, and a mask one of 16 bits: on a CPU with
AVX-512 a float32 operation is one instruction, elsewhere LLVM splits it. LLVM's own vectorizer doesn't find these
loops: plain ones take 3x the time. Without the compiler the very same kernels run on NumPy arrays of 16, which is what
each function's body does.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import lower_builtin

from msdgs_serve.rasterizer.lane_types import (
    FREEDOMS,
    LANES,
    MASK,
    REALS,
    Index,
    Lanes,
    LanesType,
    Mask,
    MaskType,
    broadcast,
    llvm,
    lowered,
    same,
    shuffled,
    suffix,
    typed,
)


def _same_or_number(a: types.Type, b: types.Type) -> types.Type | None:
    """The type of the lanes where both arguments are alike or one is a single number."""
    number = (types.Float, types.Integer)
    if isinstance(a, LanesType) and isinstance(b, number):
        return a
    if isinstance(b, LanesType) and isinstance(a, number):
        return b
    return same(a, b)


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
    lowered(operator.neg, LanesType)(lambda b, x: b.fneg(x))


def _lower_mixed(function: Callable, lower: Callable) -> None:
    """For lanes and lanes, lanes and a number, a number and lanes."""

    def code(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        like = next(kind for kind in signature.args if isinstance(kind, LanesType))
        lanes = [
            value
            if isinstance(kind, LanesType)
            else broadcast(builder, context.cast(builder, value, kind, like.dtype), like.count)
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


typed(spread, lambda value: LanesType(value) if isinstance(value, types.Float) else None)
for _number in REALS:
    lowered(spread, _number)(lambda b, value: broadcast(b, value))


def filled(value: Any, like: Lanes) -> Lanes:
    """One number in as many lanes, and of the type, of another `Lanes`."""
    return np.full_like(like, value)


typed(filled, lambda value, like: like if isinstance(like, LanesType) else None)


@lower_builtin(filled, types.Number, LanesType)
def _lower_filled(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    like = signature.args[1]
    return broadcast(builder, context.cast(builder, values[0], signature.args[0], like.dtype), like.count)


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


typed(fma, lambda a, b, c: same(a, b, c))
typed(minimum, lambda a, b: same(a, b))
typed(maximum, lambda a, b: same(a, b))
typed(square_root, lambda a: same(a))
typed(negative, lambda a: same(a))
typed(select, lambda mask, a, b: same(a, b) if _mask_for(a) == mask else None)
typed(times_power_of_two, lambda a, rounded: same(a, rounded))
typed(rounder, lambda a: a.dtype if isinstance(a, LanesType) else None)


def converted(a: Lanes, like: np.ndarray) -> Lanes:
    """The same numbers in the dtype of an array."""
    return a.astype(like.dtype)


def exponent_of(a: Lanes) -> Lanes:
    """⌊log2 a⌋ of positive normal numbers."""
    return (np.frexp(a)[1] - 1).astype(a.dtype)


def mantissa_of(a: Lanes) -> Lanes:
    """a / 2^exponent_of(a), in [1, 2)."""
    return 2 * np.frexp(a)[0]


typed(exponent_of, lambda a: same(a))
typed(mantissa_of, lambda a: same(a))
typed(converted, lambda a, like: LanesType(like.dtype, a.count) if same(a) and isinstance(like, types.Array) else None)


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


lowered(fma, LanesType, LanesType, LanesType)(lambda b, x, y, z: llvm(b, f"llvm.fma.{suffix(x.type)}", x.type, x, y, z))
lowered(minimum, LanesType, LanesType)(lambda b, x, y: b.select(b.fcmp_ordered("<", x, y), x, y))
lowered(maximum, LanesType, LanesType)(lambda b, x, y: b.select(b.fcmp_ordered(">", x, y), x, y))
lowered(square_root, LanesType)(lambda b, x: llvm(b, f"llvm.sqrt.{suffix(x.type)}", x.type, x))
lowered(negative, LanesType)(_with_sign)
lowered(select, MaskType, LanesType, LanesType)(lambda b, mask, x, y: b.select(mask, x, y))
lowered(times_power_of_two, LanesType, LanesType)(_times_power)
lowered(exponent_of, LanesType)(_exponent)
lowered(mantissa_of, LanesType)(_mantissa)


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


typed(pair, lambda a, b: LanesType(a.dtype, 2 * a.count) if same(a, b) else None)
typed(first_of, lambda pair_: _half_of(pair_))
typed(second_of, lambda pair_: _half_of(pair_))
lowered(pair, LanesType, LanesType)(lambda b, x, y: shuffled(b, x, y, range(2 * x.type.count)))
for _either in (LanesType, MaskType):
    lowered(first_of, _either)(lambda b, x: shuffled(b, x, x, range(x.type.count // 2)))
    lowered(second_of, _either)(lambda b, x: shuffled(b, x, x, range(x.type.count // 2, x.type.count)))


def bits_of(mask: Mask) -> Any:
    """The mask as a number: lane 0 is bit 0."""
    return int(np.dot(mask, 1 << np.arange(LANES)))


typed(bits_of, lambda mask: types.uint64 if mask == MASK else None)
lowered(bits_of, MASK)(lambda b, mask: b.zext(b.bitcast(mask, ir.IntType(LANES)), ir.IntType(64)))


def lowest_bit(bits: Index) -> Any:
    """The place of the lowest set bit of a number that is not 0."""
    return (int(bits) & -int(bits)).bit_length() - 1


typed(lowest_bit, lambda bits: types.uint64 if bits == types.uint64 else None)
lowered(lowest_bit, types.uint64)(lambda b, bits: b.cttz(bits, ir.Constant(ir.IntType(1), 1)))
