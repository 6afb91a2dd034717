"""What benchmarks share: times of things that take turns, PSNR of two images, where and when a run was made."""

import contextlib
import platform
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from msdgs_serve.threads import thread_count


class Times:
    """Seconds of things that take turns, by name."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def add(self, name: str, seconds: float) -> None:
        self.seconds[name].append(seconds)

    def time(self, name: str, function: Callable, *arguments: Any) -> Any:
        """Call the function, keep its time, return its result."""
        start = self._clock()
        result = function(*arguments)
        self.add(name, self._clock() - start)
        return result

    def minimum(self, name: str) -> float:
        """Milliseconds."""
        return 1e3 * min(self.seconds[name])

    def milliseconds(self) -> dict[str, dict[str, float]]:
        """Minimum and median of each."""
        return {
            name: {"min": self.minimum(name), "median": 1e3 * float(np.median(seconds))}
            for name, seconds in self.seconds.items()
        }


def minimum_and_median(times: dict[str, float]) -> str:
    """A table's cell."""
    return f"{times['min']:.1f} ({times['median']:.1f})"


def psnr(image: np.ndarray, other: np.ndarray) -> float:
    """dB of two images, clipped to [0, 1]; infinite if they are the same."""
    error = float(np.mean((np.clip(image, 0, 1).astype(float) - np.clip(other, 0, 1)) ** 2))
    return -10 * np.log10(error) if error else float("inf")


def machine() -> str:
    """Processor, threads, Python and date, for the head of a report."""
    return f"{cpu_name()}, {thread_count()} threads, Python {platform.python_version()}, {time.strftime('%Y-%m-%d')}"


def cpu_name() -> str:
    """From Linux, or else what Python knows."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()
