"""Service levels: rows of a table with a bound, the measured value, and whether the bound is met."""

import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.table import Table

SCENE = Path(__file__).resolve().parents[2] / "examples" / "toys.onnx"
"""The default scene. Its time range is [0, 1], as these benchmarks require."""


class Row(NamedTuple):
    """One service level."""

    name: str
    bound: str
    measured: str
    met: bool | None  # None: no bound


class Settings(NamedTuple):
    """Inputs of every part of the benchmark."""

    scene: Path  # a scene file
    folder: Path  # of three scenes, see `make_scenes`
    work: Path  # a folder for files that are written
    minutes: float | None = None  # duration of a long part, if it isn't that part's own
    overload_seconds: float = 60.0

    def seconds(self, minutes: float) -> float:
        """The duration of a part that takes `minutes` by default."""
        return 60 * (minutes if self.minutes is None else self.minutes)


def print_rows(rows: Iterable[Row]) -> bool:
    """Print the table; returns whether all bounds are met."""
    table, all_met = Table("service level", "bound", "measured", "met", title=time.strftime("%Y-%m-%d")), True
    for row in rows:
        table.add_row(row.name, row.bound, row.measured, {True: "yes", False: "NO", None: ""}[row.met])
        all_met &= row.met is not False
    Console(width=max(Console().width, 120)).print(table)
    return all_met


def memory_row(name: str, samples: Sequence[int]) -> Row:
    """Whether memory grows: bytes, sampled at regular intervals, in the last fifth of the time and in the second."""
    fifth = max(1, len(samples) // 5)
    second, last = float(np.median(samples[fifth : 2 * fifth])), float(np.median(samples[-fifth:]))
    measured = f"{last / second - 1:+.1%} ({second / 2**20:.0f} to {last / 2**20:.0f} MiB)"
    return Row(f"{name}, the last fifth of the time against the second", "within 5 %", measured, last / second <= 1.05)
