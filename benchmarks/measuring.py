"""Common parts of the benchmarks: times of functions that take turns, PSNR, tables, and the machine's name."""

import platform
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from msdgs_export.measure.machine import processor
from msdgs_serve.threads import thread_count

REPORT_WIDTH = 170
"""Characters per line of a report that isn't printed to a terminal."""


class Times:
    """Seconds by name, of functions that are measured in turns."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter) -> None:
        self._clock = clock
        self.seconds: dict[str, list[float]] = defaultdict(list)

    def add(self, name: str, seconds: float) -> None:
        self.seconds[name].append(seconds)

    def time(self, name: str, function: Callable, *arguments: Any) -> Any:
        """Call the function, store its time, return its result."""
        start = self._clock()
        result = function(*arguments)
        self.add(name, self._clock() - start)
        return result

    def minimum(self, name: str) -> float:
        """The shortest time in milliseconds."""
        return 1e3 * min(self.seconds[name])

    def milliseconds(self) -> dict[str, dict[str, float]]:
        """Minimum and median by name."""
        return {
            name: {"min": self.minimum(name), "median": 1e3 * float(np.median(seconds))}
            for name, seconds in self.seconds.items()
        }


def minimum_and_median(times: dict[str, float]) -> str:
    """Milliseconds as a cell of a table."""
    return f"{times['min']:.1f} ({times['median']:.1f})"


def psnr(image: np.ndarray, other: np.ndarray) -> float:
    """PSNR in dB of two images, clipped to [0, 1]; infinite if they are equal."""
    error = float(np.mean((np.clip(image, 0, 1).astype(float) - np.clip(other, 0, 1)) ** 2))
    return -10 * np.log10(error) if error else float("inf")


def machine() -> str:
    """Processor, threads, Python and date, for the head of a report."""
    return f"{processor()}, {thread_count()} threads, Python {platform.python_version()}, {time.strftime('%Y-%m-%d')}"


def report_console() -> Console:
    """The terminal, or plain text wide enough for the tables if the output goes to a file."""
    return Console(highlight=False, width=None if sys.stdout.isatty() else REPORT_WIDTH)


def table(title: str, *columns: str) -> Table:
    """A table with names in its first column and numbers, aligned to the right, in the others."""
    made = Table(title=title, title_justify="left")
    for k, column in enumerate(columns):
        made.add_column(column, justify="right" if k else "left")
    return made
