"""Terminal output of `msdgs-train compare`: a bar over the runs, and a line per ended run."""

from typing import Self

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeElapsedColumn, TimeRemainingColumn

from msdgs_train.comparison.matrix import Run
from msdgs_train.comparison.pools import RunEnd


class ComparisonProgress:
    """A bar over the runs of a comparison, and a line per ended run."""

    def __init__(self, console: Console, total: int) -> None:
        self._console = console
        self._bar = Progress(
            BarColumn(None), MofNCompleteColumn(), TimeElapsedColumn(), TimeRemainingColumn(),
            console=console, disable=not console.is_terminal,
        )  # fmt: skip
        self._task = self._bar.add_task("runs", total=total)

    def __enter__(self) -> Self:
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def ended(self, run: Run, ended: RunEnd) -> None:
        """Report the end of a run."""
        self._bar.advance(self._task)
        line = f"{run.name}: {ended.status}" + (f", {ended.message}" if ended.message else "")
        self._console.print(line, soft_wrap=True, markup=False, style="red" if ended.status == "failed" else None)
