"""A render job: times its stages and can be cancelled."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from msdgs_serve.scene import MsdgsError
from msdgs_serve.threads import checking


class RenderCancelled(MsdgsError):
    """The job was cancelled: its client is gone or its time limit has passed."""


class RenderJob:
    """Times the stages of a render by name. One thread works on it; any thread may cancel it, which ends the work at
    its next check."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}  # by stage; repeated stages add up
        self.notes: dict[str, str] = {}  # remarks by stage, such as pose: "hit"
        self._cancelled = False

    def cancel(self) -> None:
        """End the job at its next check."""
        self._cancelled = True

    def check(self) -> None:
        """Raise `RenderCancelled` if the job was cancelled."""
        if self._cancelled:
            raise RenderCancelled("the render was cancelled")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time the stage, and check before it and before each part of its work on the thread pool."""
        self.check()
        started = time.perf_counter()
        try:
            with checking(self.check):
                yield
        finally:
            self.add(name, time.perf_counter() - started)

    def add(self, name: str, seconds: float) -> None:
        """Add time to a stage."""
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
