"""What all commands print with, and how they end."""

from collections.abc import Sequence
from typing import Protocol

from rich.console import Console
from rich.table import Table

EXIT_INVALID = 2
EXIT_INTERRUPTED = 130  # as a shell reports a program that Ctrl-C has stopped

console = Console()


class Command(Protocol):
    """The options of one command, and what it does."""

    def execute(self) -> int:
        """Do it; returns the exit code."""
        ...


def rich_table(
    headings: Sequence[str], rows: Sequence[Sequence[str]], *, names: int, title: str | None = None
) -> Table:
    """Numbers are right-aligned, the first `names` columns left-aligned."""
    shown = Table(title=title)
    for i, heading in enumerate(headings):
        shown.add_column(heading, justify="left" if i < names else "right")
    for row in rows:
        shown.add_row(*row)
    return shown
