"""numba types of SIMD vectors and masks, and helpers to define operations on them in LLVM."""

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
"""16 numbers: an LLVM vector in compiled kernels, an array [16] without the compiler."""
Mask = Any
"""16 booleans."""
Index = int | np.integer
"""An index or a set of bits. Kernels use np.uint64, or numba tests every index for negative values: 3.5x the time."""


class VectorType(types.Type):
    """numba's type of a vector of 16 numbers, or of 32 in a `pair`."""

    def __init__(self, dtype: types.Type, count: int = NUM_LANES) -> None:
        self.dtype, self.count = dtype, count
        super().__init__(f"Vector({dtype}, {count})")


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, ir.VectorType(manager.lookup(fe_type.dtype).get_data_type(), fe_type.count))


class MaskType(types.Type):
    """numba's type of a mask of 16 booleans, or of 32."""

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
    """Tell numba the type of `function(*arguments)`; None if it doesn't take such arguments."""

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
    """Build a call of the LLVM intrinsic `name`."""
    kind = ir.FunctionType(result, [value.type for value in values])
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), values)


def suffix(vector: ir.VectorType) -> str:
    """Return the suffix of LLVM intrinsics for a vector type."""
    kinds = {ir.FloatType(): "f32", ir.DoubleType(): "f64", ir.IntType(64): "i64"}
    return f"v{vector.count}{kinds[vector.element]}"


def broadcast(builder: Any, value: Any, count: int = NUM_LANES) -> Any:
    """Build a vector with one value in all lanes."""
    vector = ir.VectorType(value.type, count)
    first = builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(ir.IntType(32), 0))
    zeros = ir.Constant(ir.VectorType(ir.IntType(32), count), [0] * count)
    return builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), zeros)


def same(*arguments: types.Type) -> types.Type | None:
    """Return the vector type that all arguments have, or None if they differ."""
    return arguments[0] if isinstance(arguments[0], VectorType) and set(arguments) == {arguments[0]} else None


def shuffled(builder: Any, a: Any, b: Any, lanes: Sequence[int]) -> Any:
    """Build a vector of the given lanes of `a` and `b`, which are numbered from the first of `a` to the last of `b`."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), list(lanes)))


def is_array(array: Any, ndim: int) -> bool:
    """Whether a type is a C-ordered array of float32 or float64 with so many axes."""
    shaped = isinstance(array, types.Array) and array.ndim == ndim and array.layout == "C"
    return shaped and array.dtype in REALS


def none_if(fits: Any) -> types.Type | None:
    """Return the result type of a function that returns nothing, or None if the arguments don't fit."""
    return types.none if fits else None


def first_lanes(builder: Any, count: Any) -> Any:
    """Build the mask of the first `count` lanes; `count` is an i64 that may be negative or above 16."""
    integers = ir.VectorType(ir.IntType(64), NUM_LANES)
    return builder.icmp_signed("<", ir.Constant(integers, list(range(NUM_LANES))), broadcast(builder, count))


def masked_load(builder: Any, place: Any, alignment: int, mask: Any, otherwise: Any) -> Any:
    """Build a load of the lanes in `mask`; the others are those of `otherwise`."""
    name = f"llvm.masked.load.{suffix(otherwise.type)}.p0"
    return llvm(builder, name, otherwise.type, place, ir.Constant(ir.IntType(32), alignment), mask, otherwise)


def masked_store(builder: Any, place: Any, alignment: int, mask: Any, vector: Any) -> None:
    """Build a store of the lanes in `mask`."""
    name = f"llvm.masked.store.{suffix(vector.type)}.p0"
    llvm(builder, name, ir.VoidType(), vector, place, ir.Constant(ir.IntType(32), alignment), mask)
