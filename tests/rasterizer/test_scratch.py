"""Memory of intermediate arrays is lent again, never twice at once."""

import gc
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from msdgs_serve.rasterizer import scratch as module
from msdgs_serve.rasterizer.scratch import aligned, release_scratch, scratch, unused_bytes


@pytest.fixture(autouse=True)
def nothing_unused():
    release_scratch()


def address(array: np.ndarray) -> int:
    return array.ctypes.data


def test_memory_is_lent_again_once_no_view_is_left():
    array = scratch((100, 16), np.float32)
    assert (array.shape, array.dtype, array.flags.c_contiguous, array.flags.writeable) == (
        (100, 16),
        np.float32,
        True,
        True,
    )
    first, view = address(array), array[10:].T
    assert first % 64 == 0
    del array
    beside = scratch((100, 16), np.float32)
    assert address(beside) != first
    view[:] = 1
    del view
    again = scratch((100, 16), np.float32)
    assert address(again) == first
    del again
    small, other = scratch((1,), np.uint8), scratch((800,), np.uint64)
    assert address(small) != first
    assert address(other) == first


def test_no_more_is_kept_than_the_limit(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "KEPT_BYTES", 10_000)
    arrays = [scratch((4_000,), np.uint8) for _ in range(5)]
    last = address(arrays[-1])
    while arrays:
        del arrays[0]
    assert len(module._unused) == 2
    assert 8_000 <= unused_bytes() <= 10_000
    assert address(scratch((4_000,), np.uint8)) == last
    assert scratch((20_000,), np.uint8).size == 20_000
    assert len(module._unused) == 2
    assert scratch((0, 16), np.float64).shape == (0, 16)


def test_threads_never_share_memory():
    def work(number: int) -> None:
        for k in range(200):
            array = scratch((50 + (k * number) % 40,), np.int64)
            array[:] = number
            other = scratch((60,), np.int64)
            other[:] = -number
            assert (array == number).all()
            assert (other == -number).all()

    with ThreadPoolExecutor(8) as pool:
        list(pool.map(work, range(1, 9)))


def test_arrays_may_end_in_a_garbage_collection_at_any_moment():
    thresholds = gc.get_threshold()
    try:
        for allocations in range(4, 44, 4):  # before the next collection
            release_scratch()
            kept = [scratch((1_000 * k,), np.uint8) for k in range(1, 31)]
            array = scratch((500_000,), np.uint8)
            del kept
            gc.collect()
            cycle: list = [array]
            cycle.append(cycle)
            del cycle, array
            gc.set_threshold(allocations)
            assert scratch((8,), np.float64).shape == (8,)
            gc.set_threshold(*thresholds)
    finally:
        gc.set_threshold(*thresholds)


def test_what_is_kept_between_frames_has_memory_of_its_own():
    lent = scratch((4_000,), np.uint8)
    del lent
    kept = aligned((10, 16), np.float32)
    assert address(kept) % 64 == 0
    assert kept.nbytes == 640
    assert unused_bytes() >= 4_000
