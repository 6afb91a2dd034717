"""Peak memory of a function (Linux)."""

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
STATUS, FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def measured(work: Callable[[], T]) -> tuple[T, float]:
    """Return the result of a function and by how many MB it raised the peak memory of the process."""
    before = resident_megabytes()  # reusing memory freed by earlier work would hide allocations
    FORGET.write_text("5")  # resets the peak
    result = work()
    return result, _memory("VmHWM") - before


def resident_megabytes() -> float:
    """Return the memory in use, after glibc has returned free memory."""
    ctypes.CDLL(None).malloc_trim(0)
    return _memory("VmRSS")


def _memory(name: str) -> float:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024
