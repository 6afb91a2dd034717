"""The console, tables and progress bars that commands share."""

import contextlib
from collections.abc import Callable, Iterator, Sequence

from rich.console import Console
from rich.progress import Progress, ProgressColumn
from rich.table import Table

console = Console(markup=False)  # names of files may have brackets


def rich_table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], *, names: int, title: str | None = None
) -> Table:
    """Return a table whose first `names` columns are left-aligned, and the others right-aligned."""
    shown = Table(title=title)
    for i, heading in enumerate(headings):
        shown.add_column(heading, justify="left" if i < names else "right")
    for row in rows:
        shown.add_row(*row)
    return shown


def progress_bar(*columns: ProgressColumn) -> Progress:
    """Return a progress bar, with rich's own columns if none are given; hidden if the output is not a terminal."""
    return Progress(*columns, console=console, disable=not console.is_terminal)


@contextlib.contextmanager
def frame_progress(total: int) -> Iterator[Callable[[int, int], None]]:
    """A bar over frames; yields a function of (done, total)."""
    with progress_bar() as bar:
        task = bar.add_task("frames", total=total)
        yield lambda done, of: bar.update(task, completed=done, total=of)
