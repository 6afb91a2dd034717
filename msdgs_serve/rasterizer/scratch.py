"""Memory of a frame's intermediate arrays, kept for the next frame.

The C library gives large arrays back to the system, which clears their pages again for each frame: that makes a frame
of 100,000 Gaussians take 1.15 times as long.
"""

import math
import weakref

import numpy as np
import numpy.typing as npt

KEPT_BYTES = 1 << 28
"""Unused memory that is kept; the records of 4,000,000 Gaussians."""
MAX_WASTE = 4
"""An array may take memory of up to so many times its size."""
CACHE_LINE_BYTES = 64

_unused: dict[int, np.ndarray] = {}
"""By identity, oldest first. Single operations are atomic, but before Python 3.12 `list(_unused.items())` isn't: its
tuples may start a garbage collection, which ends the last use of other arrays."""


def scratch(shape: tuple[int, ...], dtype: npt.DTypeLike) -> np.ndarray:
    """Return an array like `np.empty`, aligned to 64 bytes, whose memory is kept for others once no array refers to
    it."""
    memory = _taken(_size(shape, dtype) + CACHE_LINE_BYTES)
    # views of an array refer to it, but not to the memory below it, which has a type of its own
    lent = np.frombuffer(memory.data, np.uint8)
    weakref.finalize(lent, _keep, memory).atexit = False
    return _view(lent, shape, dtype)


def aligned(shape: tuple[int, ...], dtype: npt.DTypeLike) -> np.ndarray:
    """Return an array like `np.empty`, aligned to 64 bytes, of memory of its own: for what is kept between frames."""
    return _view(np.empty(_size(shape, dtype) + CACHE_LINE_BYTES, np.uint8), shape, dtype)


def unused_bytes() -> int:
    """Memory that is kept and not lent."""
    return sum(memory.nbytes for memory in list(_unused.values()))


def release_scratch() -> None:
    """Give unused memory back."""
    _unused.clear()


def _size(shape: tuple[int, ...], dtype: npt.DTypeLike) -> int:
    return math.prod(shape) * np.dtype(dtype).itemsize


def _view(memory: np.ndarray, shape: tuple[int, ...], dtype: npt.DTypeLike) -> np.ndarray:
    start = -memory.ctypes.data % CACHE_LINE_BYTES
    return memory[start : start + _size(shape, dtype)].view(dtype).reshape(shape)


def _taken(size: int) -> np.ndarray:
    newest_first = reversed(list(_unused.values()))  # what was used last may be in a cache
    for memory in sorted(newest_first, key=lambda memory: memory.nbytes):
        if size <= memory.nbytes <= MAX_WASTE * size and _unused.pop(id(memory), None) is not None:
            return memory
    return np.empty(size, np.uint8)


def _keep(memory: np.ndarray) -> None:
    if memory.nbytes > KEPT_BYTES:
        return
    _unused[id(memory)] = memory
    excess = unused_bytes() - KEPT_BYTES
    for oldest in list(_unused.values()):
        if excess > 0 and _unused.pop(id(oldest), None) is not None:
            excess -= oldest.nbytes
