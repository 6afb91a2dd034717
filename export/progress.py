"""Progress of long tasks."""

from collections.abc import Callable

Track = Callable[[str, int], Callable[[], object]]
"""Called with the name of a task and its number of steps; returns a function to call after each step."""


def no_progress(name: str, steps: int) -> Callable[[], object]:
    """Ignore progress."""
    return lambda: None
