"""Load vectors from arrays and store them: contiguous numbers, or columns of 16 rows.

The body of each function is its definition without the compiler, as in `vectors.py`. Rows of 3 and 4 numbers have loads
of their own: with masked loads of 16 columns for any width the projection takes 1.2 to 1.5 times as long.
"""

from typing import Any

import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.extending import lower_builtin

from msdgs_serve.rasterizer.simd.types import (
    NUM_LANES,
    Index,
    Vector,
    VectorType,
    broadcast,
    first_lanes,
    is_array,
    llvm,
    masked_load,
    masked_store,
    none_if,
    shuffled,
    typed,
)
from msdgs_serve.rasterizer.simd.vectors import as_rows, padded


def _columns_of(array: Any, count: int) -> types.Type | None:
    return types.UniTuple(VectorType(array.dtype), count) if is_array(array, 2) else None


def _vector_at(context: Any, builder: Any, signature: Any, values: Any) -> tuple[Any, int]:
    """Return a pointer to 16 numbers of the first argument, an array, at the second, an index, and its alignment."""
    kind = signature.args[0]
    data = context.make_array(kind)(context, builder, values[0]).data
    place = builder.gep(data, [context.cast(builder, values[1], signature.args[1], types.intp)])
    vector = ir.VectorType(context.get_data_type(kind.dtype), NUM_LANES)
    return builder.bitcast(place, vector.as_pointer()), kind.dtype.bitwidth // 8


def load(array: np.ndarray, start: Index) -> Vector:
    """Return 16 consecutive numbers of an array [n]."""
    return array[int(start) : int(start) + NUM_LANES].copy()


def store(array: np.ndarray, start: Index, vector: Vector) -> None:
    """Write 16 consecutive numbers of an array [n]."""
    array[int(start) : int(start) + NUM_LANES] = vector


def load_or(array: np.ndarray, start: Index, otherwise: Vector) -> Vector:
    """Return 16 numbers of an array [n] from `start`, or those of `otherwise` past its end."""
    found = array[int(start) : int(start) + NUM_LANES]
    return np.concatenate([found, otherwise[len(found) :]])


def load_triples(array: np.ndarray, first_row: Index) -> tuple[Vector, Vector, Vector]:
    """Return the columns of 16 rows of an array [n, 3], 0 past its last row."""
    found = array[int(first_row) :][:NUM_LANES]
    x, y, z = np.concatenate([found, np.zeros((NUM_LANES - len(found), 3), array.dtype)]).T.copy()
    return x, y, z


def load_four_columns(array: np.ndarray, first_row: Index, first_column: Index) -> tuple[Vector, ...]:
    """Return 4 columns, which must exist, of 16 rows of an array [n, m]; past the last row that row is repeated."""
    rows = np.minimum(np.arange(int(first_row), int(first_row) + NUM_LANES), len(array) - 1)
    return tuple(array[rows, int(first_column) : int(first_column) + 4].T.copy())


def load_columns(array: np.ndarray, first_row: Index) -> tuple[Vector, ...]:
    """Return the columns of 16 rows of an array [n, 16]; past the last row that row is repeated."""
    return tuple(column for first in range(0, NUM_LANES, 4) for column in load_four_columns(array, first_row, first))


def load_columns_of(array: np.ndarray, rows: np.ndarray, start: Index) -> tuple[Vector, ...]:
    """Return the columns of an array [n, 16] at 16 row indices, which are those of `rows` [m] from `start`; past the
    end of `rows` its last index is repeated."""
    found = rows[np.minimum(np.arange(int(start), int(start) + NUM_LANES), len(rows) - 1)]
    return tuple(array[found].T.copy())


def store_columns(array: np.ndarray, first_row: Index, first_column: Index, columns: tuple[Vector, ...]) -> None:
    """Write up to 16 columns, and 0 in the remaining ones, into 16 rows of an array [n, m]; numbers past its rows and
    columns are dropped."""
    block = array[int(first_row) :, int(first_column) :][:NUM_LANES, :NUM_LANES]
    block[:] = as_rows(columns).T[: block.shape[0], : block.shape[1]]


def store_rows(array: np.ndarray, first_row: Index, columns: tuple[Vector, ...]) -> None:
    """Write up to 16 columns, and 0 in the remaining ones, into 16 rows, which must exist, of an array [n, 16]."""
    array[int(first_row) : int(first_row) + NUM_LANES] = as_rows(columns).T


def store_uint16(array: np.ndarray, first_row: Index, columns: tuple[Vector, ...]) -> None:
    """Truncate 4 columns of numbers in [0, 65535] to integers and write them into 16 rows of an array [n, 4] of uint16;
    rows past its end are dropped."""
    rows = array[int(first_row) :][:NUM_LANES]
    rows[:] = np.stack(columns, axis=1)[: len(rows)]


def append_keys(keys: np.ndarray, end: int, lanes: Index, depths: Vector, first_row: Index) -> int:
    """Write for each lane in a set of bits its depth's bits as float32 above its row's index into `keys` [n] of uint64
    from `end`; return the new end. The 16 numbers from `end` must exist and may be overwritten."""
    chosen = np.flatnonzero(int(lanes) >> np.arange(NUM_LANES) & 1)
    above = depths[chosen].astype(np.float32).view(np.uint32).astype(np.uint64) << np.uint64(32)
    keys[end : end + len(chosen)] = above | (int(first_row) + chosen).astype(np.uint64)
    return end + len(chosen)


typed(load, lambda array, start: VectorType(array.dtype) if is_array(array, 1) else None)
typed(store, lambda array, start, vector: none_if(is_array(array, 1) and VectorType(array.dtype) == vector))
typed(load_or, lambda array, start, otherwise: otherwise if is_array(array, 1) else None)
typed(load_triples, lambda array, row: _columns_of(array, 3))
typed(load_four_columns, lambda array, row, column: _columns_of(array, 4))
typed(load_columns, lambda array, row: _columns_of(array, NUM_LANES))
typed(load_columns_of, lambda array, rows, start: _columns_of(array, NUM_LANES))
typed(store_columns, lambda array, row, column, columns: none_if(is_array(array, 2)))


@lower_builtin(load, types.Array, types.Integer)
def _lower_load(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    place, alignment = _vector_at(context, builder, signature, values)
    return builder.load(place, align=alignment)


@lower_builtin(store, types.Array, types.Integer, VectorType)
def _lower_store(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    place, alignment = _vector_at(context, builder, signature, values)
    builder.store(values[2], place, align=alignment)
    return context.get_dummy_value()


@lower_builtin(load_or, types.Array, types.Integer, VectorType)
def _lower_load_or(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    place, alignment = _vector_at(context, builder, signature, values)
    array = context.make_array(signature.args[0])(context, builder, values[0])
    start = context.cast(builder, values[1], signature.args[1], types.intp)
    count = builder.sub(builder.extract_value(array.shape, 0), start)
    return masked_load(builder, place, alignment, first_lanes(builder, count), values[2])


def _transposed(builder: Any, vectors: list[Any]) -> list[Any]:
    """Return the rows of a matrix whose columns are 16 vectors: squares of 4 × 4 numbers are transposed, then put
    together: shuffles of AVX2 cross the halves of a vector in the second half of the steps only."""
    low, high, even, odd = (
        [4 * quarter + k for quarter in quarters for k in range(4)]
        for quarters in ((0, 1, 4, 5), (2, 3, 6, 7), (0, 2, 4, 6), (1, 3, 5, 7))
    )
    squares = [_squares_transposed(builder, vectors[k : k + 4]) for k in range(0, NUM_LANES, 4)]
    rows = [
        (shuffled(builder, a, b, half), shuffled(builder, c, d, half))
        for half in (low, high)
        for a, b, c, d in zip(*squares, strict=True)
    ]
    upper, lower = rows[:4], rows[4:]
    return [shuffled(builder, *pair, lanes) for pairs in (upper, lower) for lanes in (even, odd) for pair in pairs]


def _squares_transposed(builder: Any, v: list[Any]) -> list[Any]:
    """Return four vectors of which number k of quarter q of result r is number r of quarter q of vector k."""
    low, high = (
        [lane for q in range(k, NUM_LANES, 4) for lane in (q, NUM_LANES + q, q + 1, NUM_LANES + q + 1)] for k in (0, 2)
    )
    v = [shuffled(builder, a, b, lanes) for lanes in (low, high) for a, b in (v[:2], v[2:])]
    low, high = (
        [lane for q in range(k, NUM_LANES, 4) for lane in (q, q + 1, NUM_LANES + q, NUM_LANES + q + 1)] for k in (0, 2)
    )
    return [shuffled(builder, a, b, lanes) for a, b in (v[:2], v[2:]) for lanes in (low, high)]


def _rows(context: Any, builder: Any, kind: Any, array: Any, first_row: Any, first_column: Any) -> tuple[Any, Any, Any]:
    """Return pointers to 16 rows of an array [n, m], and how many rows and columns there are from the first."""
    array = context.make_array(kind)(context, builder, array)
    count, width = (builder.extract_value(array.shape, axis) for axis in (0, 1))
    start = builder.add(builder.mul(first_row, width), first_column)
    vector = ir.VectorType(context.get_data_type(kind.dtype), NUM_LANES).as_pointer()
    places = []
    for row in range(NUM_LANES):
        offset = builder.add(start, builder.mul(width, ir.Constant(ir.IntType(64), row)))
        places.append(builder.bitcast(builder.gep(array.data, [offset]), vector))
    return places, builder.sub(count, first_row), builder.sub(width, first_column)


@lower_builtin(load_triples, types.Array, types.Integer)
def _lower_load_triples(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    """Load 48 consecutive numbers; a column takes two shuffles."""
    kind = signature.args[0]
    array = context.make_array(kind)(context, builder, values[0])
    row = context.cast(builder, values[1], signature.args[1], types.intp)
    three = ir.Constant(ir.IntType(64), 3)
    left = builder.mul(builder.sub(builder.extract_value(array.shape, 0), row), three)
    vector = ir.VectorType(context.get_data_type(kind.dtype), NUM_LANES)
    v = []
    for first in range(0, 3 * NUM_LANES, NUM_LANES):
        offset = builder.add(builder.mul(row, three), ir.Constant(ir.IntType(64), first))
        place = builder.bitcast(builder.gep(array.data, [offset]), vector.as_pointer())
        some = first_lanes(builder, builder.sub(left, ir.Constant(ir.IntType(64), first)))
        zeros = ir.Constant(vector, [0.0] * NUM_LANES)
        v.append(masked_load(builder, place, kind.dtype.bitwidth // 8, some, zeros))
    columns = []
    for column in range(3):
        wanted = range(column, 3 * NUM_LANES, 3)
        two = shuffled(builder, v[0], v[1], [place % (2 * NUM_LANES) for place in wanted])
        ends = [k if place < 2 * NUM_LANES else place - NUM_LANES for k, place in enumerate(wanted)]
        columns.append(shuffled(builder, two, v[2], ends))
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
    """Return pointers to 16 rows of an array [n, m], repeating the last row, and the type that they point to."""
    array = context.make_array(kind)(context, builder, array)
    count, width = (builder.extract_value(array.shape, axis) for axis in (0, 1))
    rows = _up_to_last(builder, context.cast(builder, first_row, row_kind, types.intp), count)
    places = [builder.gep(array.data, [builder.mul(row, width)]) for row in rows]
    return places, context.get_data_type(kind.dtype)


def _up_to_last(builder: Any, start: Any, count: Any) -> list[Any]:
    """Return 16 indices from `start` on, as i64, clamped to `count` - 1."""
    last = builder.sub(count, ir.Constant(ir.IntType(64), 1))
    numbers = [builder.add(start, ir.Constant(ir.IntType(64), k)) for k in range(NUM_LANES)]
    return [builder.select(builder.icmp_signed("<", number, last), number, last) for number in numbers]


@lower_builtin(load_columns_of, types.Array, types.Array, types.Integer)
def _lower_load_columns_of(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    kind, row_kind = signature.args[:2]
    data = context.make_array(kind)(context, builder, values[0]).data
    rows = context.make_array(row_kind)(context, builder, values[1])
    start = context.cast(builder, values[2], signature.args[2], types.intp)
    places = []
    for entry in _up_to_last(builder, start, builder.extract_value(rows.shape, 0)):
        row = context.cast(builder, builder.load(builder.gep(rows.data, [entry])), row_kind.dtype, types.intp)
        places.append(builder.gep(data, [builder.mul(row, ir.Constant(ir.IntType(64), NUM_LANES))]))
    real = context.get_data_type(kind.dtype)
    return context.make_tuple(builder, signature.return_type, _sixteen_columns(builder, places, real))


def _sixteen_columns(builder: Any, places: list[Any], real: ir.Type) -> list[Any]:
    firsts = [ir.Constant(ir.IntType(64), first) for first in range(0, NUM_LANES, 4)]
    return [column for first in firsts for column in _four_columns(builder, places, real, first)]


def _four_columns(builder: Any, places: list[Any], real: ir.Type, first: Any) -> list[Any]:
    """Return columns `first` to `first` + 3 of the 16 rows that begin at `places`. The rows are loaded such that only
    squares of 4 × 4 numbers need to be transposed."""
    quarter, size = ir.VectorType(real, 4), 4 if real == ir.FloatType() else 8
    pieces = []
    for place in places:
        piece = builder.gep(place, [first])
        pieces.append(builder.load(builder.bitcast(piece, quarter.as_pointer()), align=size))
    v = []
    for k in range(4):
        low, high = (shuffled(builder, pieces[k + j], pieces[k + j + 4], range(8)) for j in (0, 8))
        v.append(shuffled(builder, low, high, range(16)))
    return _squares_transposed(builder, v)


@lower_builtin(store_columns, types.Array, types.Integer, types.Integer, types.UniTuple)
def _lower_store_columns(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    kind = signature.args[0]
    row, column = (
        context.cast(builder, v, t, types.intp) for v, t in zip(values[1:3], signature.args[1:3], strict=True)
    )
    places, count, width = _rows(context, builder, kind, values[0], row, column)
    rows = _transposed(builder, padded(builder, values[3]))
    some = first_lanes(builder, width)
    for k, (place, row_vector) in enumerate(zip(places, rows, strict=True)):
        with builder.if_then(builder.icmp_signed("<", ir.Constant(ir.IntType(64), k), count)):
            masked_store(builder, place, kind.dtype.bitwidth // 8, some, row_vector)
    return context.get_dummy_value()


typed(store_rows, lambda array, row, columns: none_if(is_array(array, 2)))


@lower_builtin(store_rows, types.Array, types.Integer, types.UniTuple)
def _lower_store_rows(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    kind = signature.args[0]
    array = context.make_array(kind)(context, builder, values[0])
    row = context.cast(builder, values[1], signature.args[1], types.intp)
    place = builder.gep(array.data, [builder.mul(row, ir.Constant(ir.IntType(64), NUM_LANES))])
    vector = ir.VectorType(context.get_data_type(kind.dtype), NUM_LANES).as_pointer()
    for k, row_vector in enumerate(_transposed(builder, padded(builder, values[2]))):
        there = builder.gep(place, [ir.Constant(ir.IntType(64), NUM_LANES * k)])
        builder.store(row_vector, builder.bitcast(there, vector), align=kind.dtype.bitwidth // 8)
    return context.get_dummy_value()


UINT16_ROWS = types.Array(types.uint16, 2, "C")
typed(store_uint16, lambda array, row, columns: none_if(array == UINT16_ROWS and len(columns) == 4))


@lower_builtin(store_uint16, types.Array, types.Integer, types.UniTuple)
def _lower_store_uint16(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    """Combine two columns into numbers of 32 bits, the first lower, as in little-endian memory, and interleave them."""
    array = context.make_array(signature.args[0])(context, builder, values[0])
    row = context.cast(builder, values[1], signature.args[1], types.intp)
    half, whole = (ir.VectorType(ir.IntType(bits), NUM_LANES) for bits in (32, 64))
    left, right, top, bottom = (builder.fptosi(v, half) for v in cgutils.unpack_tuple(builder, values[2]))
    sixteen = ir.Constant(half, [16] * NUM_LANES)
    across, down = (builder.or_(low, builder.shl(high, sixteen)) for low, high in ((left, right), (top, bottom)))
    rows = shuffled(builder, across, down, [lane for k in range(NUM_LANES) for lane in (k, NUM_LANES + k)])
    place = builder.gep(array.data, [builder.mul(row, ir.Constant(ir.IntType(64), 4))])
    exists = first_lanes(builder, builder.sub(builder.extract_value(array.shape, 0), row))
    masked_store(builder, builder.bitcast(place, whole.as_pointer()), 2, exists, builder.bitcast(rows, whole))
    return context.get_dummy_value()


KEYS = types.Array(types.uint64, 1, "C")
typed(append_keys, lambda keys, end, lanes, depths, row: types.intp if keys == KEYS else None)


@lower_builtin(append_keys, KEYS, types.Integer, types.Integer, VectorType, types.Integer)
def _lower_append_keys(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    """Write all 16 keys, each where the last one that counts has left off: no branch to mispredict."""
    data = context.make_array(KEYS)(context, builder, values[0]).data
    end, lanes, row = (context.cast(builder, values[k], signature.args[k], types.intp) for k in (1, 2, 4))
    integers, one = ir.VectorType(ir.IntType(64), NUM_LANES), ir.Constant(ir.IntType(64), 1)
    half, single = ir.VectorType(ir.IntType(32), NUM_LANES), ir.VectorType(ir.FloatType(), NUM_LANES)
    depths = values[3] if values[3].type == single else builder.fptrunc(values[3], single)
    above = builder.shl(builder.zext(builder.bitcast(depths, half), integers), ir.Constant(integers, [32] * NUM_LANES))
    rows = builder.add(broadcast(builder, row), ir.Constant(integers, list(range(NUM_LANES))))
    found = builder.or_(above, rows)
    for k in range(NUM_LANES):
        key = builder.extract_element(found, ir.Constant(ir.IntType(32), k))
        builder.store(key, builder.gep(data, [end]))
        bit = builder.and_(builder.lshr(lanes, ir.Constant(ir.IntType(64), k)), one)
        end = builder.add(end, bit)
    return end


def prefetch(array: np.ndarray, place: Index) -> None:
    """Prefetch the cache line of an element of an array [n]; does nothing without the compiler."""


typed(prefetch, lambda array, place: types.none)


@lower_builtin(prefetch, types.Array, types.Integer)
def _lower_prefetch(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    data = context.make_array(signature.args[0])(context, builder, values[0]).data
    place = builder.gep(data, [context.cast(builder, values[1], signature.args[1], types.intp)])
    byte = builder.bitcast(place, ir.IntType(8).as_pointer())
    read, everywhere, data_cache = (ir.Constant(ir.IntType(32), value) for value in (0, 3, 1))
    llvm(builder, "llvm.prefetch.p0", ir.VoidType(), byte, read, everywhere, data_cache)
    return context.get_dummy_value()
