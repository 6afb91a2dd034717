"""SIMD vector operations: compiled against NumPy's, which are their definition."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from msdgs_serve.rasterizer.atomic import DONE, TAKEN, all_done, fetch_add
from msdgs_serve.rasterizer.jit import kernel
from msdgs_serve.rasterizer.simd import memory, vectors
from msdgs_serve.rasterizer.simd.exponential import exp2, exp2_polynomial, log2
from msdgs_serve.rasterizer.simd.squares import (
    load_square,
    load_square_of_triples,
    store_square,
    store_square_of_triples,
)
from tests.support.tolerances import assert_close

DTYPES = pytest.mark.parametrize("dtype", [np.float32, np.float64], ids=["float32", "float64"])


def plain(compiled: Callable) -> Callable:
    """The same function without the compiler, which may be switched off."""
    return getattr(compiled, "py_func", compiled)


@kernel
def operations(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> tuple[int, int]:
    """One row of `out` for each operation."""
    x, y = memory.load(a, 0), memory.load(b, np.uint64(1))
    two = vectors.pair(x, y)
    both = vectors.minimum(two * 2 + 1, vectors.filled(0.5, two))
    mask = (x < y) | (x >= 1.5) & ~(y <= -1)
    wide = vectors.pair(two, both) > 0.25
    rows = (
        x + y,
        x - 2,
        3 * x,
        x / y,
        -x,
        vectors.fma(x, y, vectors.spread(a[3])),
        vectors.minimum(x, y),
        vectors.maximum(x, y),
        vectors.square_root(x * x),
        vectors.negative(x),
        vectors.select(mask, x, y),
        vectors.first_of(both),
        vectors.second_of(both),
        vectors.select(vectors.second_of(vectors.first_of(wide)), x, y),
        vectors.exponent_of(x * x + 0.125),
        vectors.mantissa_of(x * x + 0.125),
    )
    for k in range(16):
        memory.store(out, 16 * k, rows[k])
    memory.store(out, 256, vectors.times_power_of_two(x, y + vectors.rounder(y)))
    memory.store(out, 272, memory.load_or(a, 40, x))
    memory.store(out, 288, vectors.sums_of(rows))
    bits = vectors.bits_of(mask)
    return bits, vectors.lowest_bit(bits)


@DTYPES
def test_operations_are_what_numpy_says(dtype: type):
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=50).astype(dtype), rng.normal(size=50).astype(dtype)
    b[5] = a[4]
    got, want = np.zeros(304, dtype), np.zeros(304, dtype)
    assert operations(a, b, got) == plain(operations)(a, b, want)
    assert_close(got, want, f"vectors.{np.dtype(dtype).name}")


@kernel
def rows_and_columns(
    matrix: np.ndarray,
    out: np.ndarray,
    squares: np.ndarray,
    triples: np.ndarray,
    picked: np.ndarray,
    loaded: np.ndarray,
    points: np.ndarray,
    rows: np.ndarray,
) -> None:
    block = memory.load_columns(matrix, 3)
    memory.store_columns(out, 5, 3, block)
    store_square(squares, 2, 7, block[0])
    store_square_of_triples(triples, 1, 13, block[0], block[1], block[2])
    memory.store_columns(picked, 0, 0, memory.load_columns_of(picked, rows, 1))
    memory.store_rows(loaded, 1, memory.load_four_columns(matrix, 2, 7))
    memory.store_rows(loaded, 17, memory.load_triples(points, 2))
    memory.store_rows(loaded, 33, memory.load_triples(points, 1))
    memory.store_rows(loaded, 50, (load_square(squares, 2, 7),))
    memory.store_rows(loaded, 66, load_square_of_triples(triples, 1, 13))
    memory.prefetch(squares, 3)


@DTYPES
def test_memory(dtype: type):
    """Loads stop at the end of an array, stores don't write outside of their range."""
    matrix = np.arange(160, dtype=dtype).reshape(10, 16)
    points = np.arange(54, dtype=dtype).reshape(18, 3)
    got = [np.full((9, 16), -1, dtype), np.full(40, -1, dtype), np.full(60, -1, dtype)]
    got += [np.arange(256, dtype=dtype).reshape(16, 16), np.full((83, 16), -1, dtype)]
    want = [array.copy() for array in got]
    rows = np.array([1, 15, 4], np.uint32)
    rows_and_columns(matrix, *got, points, rows)
    plain(rows_and_columns)(matrix, *want, points, rows)
    for array, expected in zip(got, want, strict=True):
        np.testing.assert_array_equal(array, expected)
    np.testing.assert_array_equal(got[3][:, 5], [16 * 15 + 5, *[16 * 4 + 5] * 15])
    np.testing.assert_array_equal(got[0][5:, 3:], matrix[3:7, :13])
    np.testing.assert_array_equal(got[4][1:17, :4], [*matrix[2:, 7:11], *[matrix[9, 7:11]] * 8])
    np.testing.assert_array_equal(got[4][17:33, :3], points[2:])
    np.testing.assert_array_equal(got[4][33:49, :3], points[1:17])
    clamped = matrix[np.minimum(np.arange(3, 19), 9)]
    np.testing.assert_array_equal(got[4][50:66, 0], clamped[:, 0])
    np.testing.assert_array_equal(got[4][66:82, :3], clamped[:, :3])
    np.testing.assert_array_equal(got[4][[0, 49, 82]], -1)
    np.testing.assert_array_equal(got[0][:5], -1)
    np.testing.assert_array_equal(got[0][:, :3], -1)


@kernel
def whole_numbers(columns: np.ndarray, row: int, out: np.ndarray) -> None:
    a, b, c, d = (memory.load(columns, 0), memory.load(columns, 16), memory.load(columns, 32), memory.load(columns, 48))
    memory.store_uint16(out, row, (a, b, c, d))


@DTYPES
def test_whole_numbers(dtype: type):
    """Cut off at the point, up to the largest that fits; rows before and past the end stay as they are."""
    columns = np.linspace(0, 65535.9, 64).astype(dtype)
    expected = columns.reshape(4, 16).T.astype(np.uint16)
    for rows in (19, 18, 3):
        out = np.full((rows, 4), 7, np.uint16)
        whole_numbers(columns, 2, out)
        np.testing.assert_array_equal(out[2:18], expected[: rows - 2])
        assert (out[:2] == 7).all()
        assert (out[18:] == 7).all()


@kernel
def appended(keys: np.ndarray, end: int, lanes: int, depths: np.ndarray, row: int) -> int:
    return memory.append_keys(keys, end, np.uint64(lanes), memory.load(depths, 0), row)


@DTYPES
@pytest.mark.parametrize("lanes", [0, 1, 0x8000, 0xA5F0, 0xFFFF])
def test_keys_of_some_lanes_follow_one_another(lanes: int, dtype: type):
    depths = np.random.default_rng(0).uniform(0.01, 1e6, 16).astype(dtype)
    got, want = np.full(21, 7, np.uint64), np.full(21, 7, np.uint64)
    end = plain(appended)(want, 2, lanes, depths, 160)
    assert appended(got, 2, lanes, depths, 160) == end == 2 + lanes.bit_count()
    np.testing.assert_array_equal(got[:end], want[:end])
    np.testing.assert_array_equal(got[18:], 7)
    chosen = [k for k in range(16) if lanes >> k & 1]
    np.testing.assert_array_equal(want[2:end] & np.uint64(0xFFFFFFFF), [160 + k for k in chosen])
    bits = (want[2:end] >> np.uint64(32)).astype(np.uint32)
    np.testing.assert_array_equal(bits.view(np.float32), depths[chosen].astype(np.float32))


@kernel
def powers(x: np.ndarray, polynomial: tuple, out: np.ndarray, logarithms: np.ndarray) -> None:
    for k in range(0, len(x), 16):
        power = exp2(memory.load(x, k), polynomial)
        memory.store(out, k, power)
        memory.store(logarithms, k, log2(power))


@pytest.mark.parametrize(("dtype", "degree"), [(np.float32, 5), (np.float64, 12)])
def test_powers_and_logarithms(dtype: type, degree: int):
    x = np.linspace(-100, 1, 16_000).astype(dtype)
    x[:16] = np.arange(-15, 1)
    polynomial = tuple(map(dtype, exp2_polynomial(degree)))
    power, logarithm = np.empty_like(x), np.empty_like(x)
    powers(x, polynomial, power, logarithm)
    name = np.dtype(dtype).name
    np.testing.assert_array_equal(power[:16], np.exp2(x[:16]))
    assert_close(power / np.exp2(x.astype(float)), np.ones_like(x), f"exp2.{name}")
    assert_close(logarithm, np.log2(power.astype(float)), f"log2.{name}")


@kernel
def draw_numbers(counters: np.ndarray, count: int, drawn: np.ndarray) -> None:
    for _ in range(count):
        drawn[fetch_add(counters, TAKEN, 2)] += 1
        fetch_add(counters, DONE, 1)


def test_every_number_is_drawn_once():
    counters, drawn = np.zeros(2, np.int64), np.zeros(80_000, np.int64)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda _: draw_numbers(counters, 10_000, drawn), range(4)))
    assert counters.tolist() == [len(drawn), 40_000]
    assert (drawn[::2] == 1).all()
    assert not drawn[1::2].any()


def test_parts_that_another_thread_has_are_not_waited_for_forever():
    counters = np.array([5, 4])
    assert not all_done(counters, 5)
    counters[DONE] = 5
    assert all_done(counters, 5)
    assert counters.tolist() == [5, 5]
