"""How much memory some work takes (Linux)."""

import ctypes
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

T = TypeVar("T")
STATUS, FORGET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def measured(work: Callable[[], T]) -> tuple[T, float]:
    """What the work returns, and by how many MB it raised the process's memory at its highest."""
    ctypes.CDLL(None).malloc_trim(0)  # what earlier work left free would hide this work's
    FORGET.write_text("5")  # resets the peak
    before = _memory("VmRSS")
    result = work()
    return result, _memory("VmHWM") - before


def _memory(name: str) -> float:
    line = next(line for line in STATUS.read_text().splitlines() if line.startswith(name))
    return int(line.split()[1]) / 1024
