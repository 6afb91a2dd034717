"""A job over one piece of work: how long its stages take, and whether anybody still waits for it."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from msdgs_serve.scene import MsdgsError
from msdgs_serve.threads import checking


class RenderCancelled(MsdgsError):
    """Nobody waits for the work any more."""


class RenderJob:
    """Times stages by name; once `cancel` was called, ends the work between them and inside. One thread works, any may
    stop it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}  # by stage; one that comes again adds to its time
        self.notes: dict[str, str] = {}  # what there is to say of a stage, as in pose: "hit"
        self._cancelled = False

    def cancel(self) -> None:
        """End the work at its next check."""
        self._cancelled = True

    def check(self) -> None:
        """Raises `RenderCancelled` once `cancel` was called."""
        if self._cancelled:
            raise RenderCancelled("nobody waits for this any more")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Check, also before each part that the work inside has on the pool, and time it."""
        self.check()
        started = time.perf_counter()
        try:
            with checking(self.check):
                yield
        finally:
            self.add(name, time.perf_counter() - started)

    def add(self, name: str, seconds: float) -> None:
        """Count time to a stage."""
        self.seconds[name] = self.seconds.get(name, 0.0) + seconds
