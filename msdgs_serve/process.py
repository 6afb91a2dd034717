"""The process of a command: what Ctrl-C and warnings do from its start. Light, as it is imported before all else."""

import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

EXIT_INVALID = 2  # wrong arguments, or files that can't be used
EXIT_INTERRUPTED = 130  # the exit code of a shell for a program that Ctrl-C has stopped
STOPPING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""The signals of Ctrl-C, of the end of a service or a machine, and of a terminal that is closed."""

IMPORTING = "<frozen importlib._bootstrap>"
"""The file name of Python's own code that imports modules."""


def begin() -> None:
    """Prepare the process of a command: a Ctrl-C while modules are imported ends it with one line, and warnings and
    threads of libraries print nothing."""
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupt)
    if not sys.warnoptions:
        warnings.simplefilter("ignore")  # they are about code; those about the user's files are our own
    threading.excepthook = _report


@contextmanager
def stopped_by(handler: Callable[[int, FrameType | None], object]) -> Iterator[None]:
    """Call `handler` for the signals that are to stop a command, except for a closed terminal that is ignored, as by
    nohup. Only the main thread may receive signals: elsewhere this does nothing."""
    old = {}
    if threading.current_thread() is threading.main_thread():
        stays = signal.SIGHUP if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else None
        old = {number: signal.signal(number, handler) for number in STOPPING if number != stays}
    try:
        yield
    finally:
        for number, before in old.items():
            signal.signal(number, before)


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Raise `KeyboardInterrupt`, which the command handles, except while modules are imported: their native code turns
    exceptions into others, and nothing has been done yet."""
    while frame is not None:
        if frame.f_code.co_filename == IMPORTING:
            show_cursor = "\r\x1b[K\x1b[?25h" if os.isatty(2) else ""  # a spinner hides it
            os.write(2, f"{show_cursor}interrupted\n".encode())
            os._exit(EXIT_INTERRUPTED)
        frame = frame.f_back
    raise KeyboardInterrupt


def _report(problem: threading.ExceptHookArgs) -> None:
    """Print an exception that ended a thread, but not a system's error: that is raised again where it is waited for."""
    if not issubclass(problem.exc_type, OSError):
        threading.__excepthook__(problem)
