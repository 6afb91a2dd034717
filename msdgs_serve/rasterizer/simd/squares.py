"""Load and store vectors as squares of 4 × 4 numbers or triples of an array: the pixels of a block of an image.

The body of each function is its definition without the compiler, as in `vectors.py`.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import types
from numba.extending import lower_builtin

from msdgs_serve.rasterizer.simd.types import (
    NUM_LANES,
    Index,
    Vector,
    VectorType,
    first_lanes,
    is_array,
    masked_store,
    none_if,
    same,
    shuffled,
    typed,
)


def store_square(array: np.ndarray, start: Index, stride: Index, vector: Vector) -> None:
    """Write 4 × 4 numbers into an array [n]: 4 from `start`, the next 4 `stride` further, and so on."""
    for row, numbers in enumerate(np.reshape(vector, (4, 4))):
        array[int(start) + row * int(stride) :][:4] = numbers


def store_square_of_triples(array: np.ndarray, start: Index, stride: Index, a: Vector, b: Vector, c: Vector) -> None:
    """Write 4 × 4 triples (a, b, c) into an array [n]: 4 from `start`, the next 4 `stride` further, and so on."""
    for row, triples in enumerate(np.stack([a, b, c], axis=1).reshape(4, 12)):
        array[int(start) + row * int(stride) :][:12] = triples


def load_square(array: np.ndarray, start: Index, stride: Index) -> Vector:
    """Return 4 × 4 numbers of an array [n]: 4 from `start`, the next 4 `stride` further, and so on."""
    return np.concatenate([array[int(start) + row * int(stride) :][:4] for row in range(4)])


def load_square_of_triples(array: np.ndarray, start: Index, stride: Index) -> tuple[Vector, Vector, Vector]:
    """Return the first, second and third numbers of 4 × 4 triples of an array [n]: 4 triples from `start`, the next 4
    `stride` further, and so on."""
    triples = np.concatenate([array[int(start) + row * int(stride) :][:12] for row in range(4)])
    return triples[0::3].copy(), triples[1::3].copy(), triples[2::3].copy()


typed(store_square, lambda array, start, stride, vector: none_if(is_array(array, 1)))
typed(store_square_of_triples, lambda array, start, stride, a, b, c: none_if(is_array(array, 1) and same(a, b, c)))
typed(load_square, lambda array, start, stride: VectorType(array.dtype) if is_array(array, 1) else None)
typed(
    load_square_of_triples,
    lambda array, start, stride: types.UniTuple(VectorType(array.dtype), 3) if is_array(array, 1) else None,
)


def _store_pieces(
    context: Any, builder: Any, signature: Any, values: Any, pieces: list[Any], write: Callable | None = None
) -> Any:
    """Write vectors into the array (first argument) from the start (second), each one stride (third) further."""
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


def _load_pieces(context: Any, builder: Any, signature: Any, values: Any, count: int) -> list[Any]:
    """Load four vectors of `count` numbers of the array (first argument) from the start (second), a stride (third)
    apart."""
    kind = signature.args[0]
    data = context.make_array(kind)(context, builder, values[0]).data
    start, stride = (
        context.cast(builder, v, t, types.intp) for v, t in zip(values[1:], signature.args[1:], strict=True)
    )
    vector = ir.VectorType(context.get_data_type(kind.dtype), count).as_pointer()
    pieces = []
    for _ in range(4):
        place = builder.bitcast(builder.gep(data, [start]), vector)
        pieces.append(builder.load(place, align=kind.dtype.bitwidth // 8))
        start = builder.add(start, stride)
    return pieces


def _every(builder: Any, pieces: list[Any], first: int, step: int) -> Any:
    """Return a vector of four numbers of each of four vectors: from `first` on, `step` apart."""
    length = 4 * step
    lanes = [first + k * step for k in range(4)]
    both = [*lanes, *(length + lane for lane in lanes)]
    upper, lower = (shuffled(builder, a, b, both) for a, b in (pieces[:2], pieces[2:]))
    return shuffled(builder, upper, lower, range(NUM_LANES))


@lower_builtin(store_square, types.Array, types.Integer, types.Integer, VectorType)
def _lower_store_square(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    vector = values[3]
    rows = [shuffled(builder, vector, vector, range(4 * row, 4 * row + 4)) for row in range(4)]
    return _store_pieces(context, builder, signature, values, rows)


@lower_builtin(store_square_of_triples, types.Array, types.Integer, types.Integer, VectorType, VectorType, VectorType)
def _lower_store_square_of_triples(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    kind = signature.args[0]
    mask = first_lanes(builder, ir.Constant(ir.IntType(64), 12))
    rows = []
    for row in range(4):
        wanted = [(pixel, channel) for pixel in range(4 * row, 4 * row + 4) for channel in range(3)]
        # a shuffle has two sources: combine first and second value, then the third; the last 4 lanes are not written
        two = [channel * NUM_LANES + pixel if channel < 2 else 0 for pixel, channel in wanted]
        three = [place if channel < 2 else NUM_LANES + pixel for place, (pixel, channel) in enumerate(wanted)]
        some = shuffled(builder, values[3], values[4], [*two, 0, 0, 0, 0])
        rows.append(shuffled(builder, some, values[5], [*three, 0, 0, 0, 0]))

    def write(place: Any, row: Any) -> None:
        masked_store(builder, place, kind.dtype.bitwidth // 8, mask, row)

    return _store_pieces(context, builder, signature, values, rows, write)


@lower_builtin(load_square, types.Array, types.Integer, types.Integer)
def _lower_load_square(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    return _every(builder, _load_pieces(context, builder, signature, values, 4), 0, 1)


@lower_builtin(load_square_of_triples, types.Array, types.Integer, types.Integer)
def _lower_load_square_of_triples(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    pieces = _load_pieces(context, builder, signature, values, 12)
    return context.make_tuple(builder, signature.return_type, [_every(builder, pieces, k, 3) for k in range(3)])
