"""Progress of long tasks."""

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import MofNCompleteColumn, Progress, TimeElapsedColumn

Track = Callable[[str, int], Callable[[], object]]
"""Called with a task's name and number of steps, 0 if unknown; returns a function to call after each step."""


def no_progress(name: str, steps: int) -> Callable[[], object]:
    """Ignore progress."""
    return lambda: None


@contextmanager
def tracked(console: Console) -> Iterator[Track]:
    """Bars of the tasks that run, or in a log the times at which tasks start."""
    started = time.monotonic()
    columns = *Progress.get_default_columns(), MofNCompleteColumn(), TimeElapsedColumn()
    with Progress(*columns, console=console, transient=True) as progress:

        def track(name: str, steps: int) -> Callable[[], object]:
            if steps and not console.is_terminal:  # no progress bars in a log
                console.print(f"{time.monotonic() - started:5.0f} s  {name} …", markup=False)
            for task in progress.tasks:
                progress.update(task.id, visible=not (task.finished or task.total is None))  # so that running ones fit
            task = progress.add_task(name, total=steps or None)
            return lambda: progress.update(task, advance=1, visible=True)

        yield track
