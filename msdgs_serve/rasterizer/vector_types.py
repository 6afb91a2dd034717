"""What sixteen numbers at once are to the compiler, and how operations on them are told to it."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.datamodel import models
from numba.extending import lower_builtin, register_model, type_callable

from msdgs_serve.rasterizer.jit import FAST_MATH

NUM_LANES = 16

Vector = Any
"""16 numbers: an LLVM vector in kernels, an array [16] without the compiler."""
Mask = Any
"""16 truth values."""
Index = int | np.integer
"""A place or a set of bits. Kernels use np.uint64 for them, or numba compiles a test for negative ones into every
access: 3.5x."""


class VectorType(types.Type):
    """What numba calls 16 numbers of a type, or 32 of a `pair`."""

    def __init__(self, dtype: types.Type, count: int = NUM_LANES) -> None:
        self.dtype, self.count = dtype, count
        super().__init__(f"Vector({dtype}, {count})")


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, ir.VectorType(manager.lookup(fe_type.dtype).get_data_type(), fe_type.count))


class MaskType(types.Type):
    """What numba calls 16 truth values, or 32."""

    def __init__(self, count: int = NUM_LANES) -> None:
        self.count = count
        super().__init__(f"Mask({count})")


@register_model(MaskType)
class _MaskModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, ir.VectorType(ir.IntType(1), fe_type.count))


MASK = MaskType()
REALS = (types.float32, types.float64)
FREEDOMS = tuple(sorted(FAST_MATH))


def typed(function: Callable, result: Callable[..., types.Type | None]) -> None:
    """Tell numba the type of `function(*arguments)`; None where it doesn't take such arguments."""

    @type_callable(function)
    def typing(_context: Any) -> Callable:
        return result


def lowered(function: Callable, *arguments: Any) -> Callable:
    """Decorate `lower(builder, *values)`, which builds the LLVM code of `function` for these argument types."""

    def register(lower: Callable) -> Callable:
        @lower_builtin(function, *arguments)
        def code(_context: Any, builder: Any, _signature: Any, values: Any) -> Any:
            return lower(builder, *values)

        return lower

    return register


def llvm(builder: Any, name: str, result: ir.Type, *values: Any) -> Any:
    """A call of LLVM's own function `name`."""
    kind = ir.FunctionType(result, [value.type for value in values])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)


def suffix(vector: ir.VectorType) -> str:
    """How LLVM spells a vector type in the name of a function."""
    kinds = {ir.FloatType(): "f32", ir.DoubleType(): "f64", ir.IntType(64): "i64"}
    return f"v{vector.count}{kinds[vector.element]}"


def broadcast(builder: Any, value: Any, count: int = NUM_LANES) -> Any:
    """A vector of one value."""
    vector = ir.VectorType(value.type, count)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), count), [0] * count)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


def same(*arguments: types.Type) -> types.Type | None:
    """The one floating type of all arguments."""
    return arguments[0] if isinstance(arguments[0], VectorType) and set(arguments) == {arguments[0]} else None


def shuffled(builder: Any, a: Any, b: Any, lanes: Sequence[int]) -> Any:
    """These lanes of two vectors, counted from the first of `a` to the last of `b`."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes)))


def is_array(array: Any, ndim: int) -> bool:
    shaped = isinstance(array, types.Array) and array.ndim == ndim and array.layout == "C"
    return shaped and array.dtype in REALS


def none_if(fits: Any) -> types.Type | None:
    """What a function that returns nothing returns, for arguments that it takes."""
    return types.none if fits else None


def first_lanes(builder: Any, count: Any) -> Any:
    """The mask of the first `count` lanes, an i64 that may be negative or above 16."""
    integers = ir.VectorType(ir.IntType(64), NUM_LANES)
    return builder.icmp_signed("<", ir.Constant(integers, list(range(NUM_LANES))), broadcast(builder, count))


def masked_load(builder: Any, place: Any, alignment: int, mask: Any, otherwise: Any) -> Any:
    name = f"llvm.masked.load.{suffix(otherwise.type)}.p0"
    return llvm(builder, name, otherwise.type, place, ir.Constant(ir.IntType(32), alignment), mask, otherwise)


def masked_store(builder: Any, place: Any, alignment: int, mask: Any, vector: Any) -> None:
    name = f"llvm.masked.store.{suffix(vector.type)}.p0"
    llvm(builder, name, ir.VoidType(), vector, place, ir.Constant(ir.IntType(32), alignment), mask)
