"""One pool of threads for the whole process: nogil kernels and onnxruntime calls share it, not more than cores.

numba's own parallel layers abort when two threads enter them or when the process forks; plain threads over nogil
kernels do neither.
"""

import contextlib
import itertools
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from typing import Any

THREADS_VARIABLE = "MSDGS_THREADS"
NICENESS = 10
"""Niceness of threads that compute for requests: under too much load /live is answered in a quarter of the time that it
takes without, or less; with 5 the gain is smaller."""

_check: ContextVar[Callable[[], object] | None] = ContextVar("check", default=None)
_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_callers = 0  # within `sharing_cores` at this moment


def thread_count() -> int:
    """Threads in the pool: `MSDGS_THREADS`, or the cores this process could use when this was first asked."""
    setting = os.environ.get(THREADS_VARIABLE)
    if setting is None:
        return _cores()
    if not setting.isdecimal() or int(setting) < 1:
        raise ValueError(f"{THREADS_VARIABLE} must be a whole number above 0, got {setting!r}")
    return int(setting)


@cache
def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def checking(check: Callable[[], object]) -> Iterator[None]:
    """Within it, `run_parallel` and `run_serially` call `check` before every item: what that raises ends the work."""
    token = _check.set(check)
    try:
        yield
    finally:
        _check.reset(token)


def lower_priority() -> None:
    """This thread, and those that it starts from now on, let other threads go first (Linux).

    Without it a thread that is woken up to answer something short waits while all cores compute.
    """
    if sys.platform == "linux":  # elsewhere priorities are the process's
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)


@contextmanager
def sharing_cores() -> Iterator[None]:
    """Around what one caller computes. Where several do at once, each stays on its own thread.

    Cores that have a frame each needn't share (1.04 times as many frames a second from 8 clients), and every part is
    one more wait for Python's interpreter.
    """
    _count_callers(1)
    try:
        yield
    finally:
        _count_callers(-1)


def threads_to_use() -> int:
    """How many parts of work are worth while now: `thread_count()`, or 1 where several callers share the cores."""
    return thread_count() if _callers <= 1 else 1


def run_parallel(function: Callable[..., Any], items: Sequence[tuple]) -> list[Any]:
    """Call `function(*item)` for every item; results in the order of the items.

    On the caller's thread and the pool's, or where several callers share the cores on the caller's alone.
    The first exception is raised after all calls that began have ended. Must not be called from inside the pool.
    """
    threads = min(threads_to_use(), len(items)) if len(items) > 1 else 1
    if threads <= 1:
        return run_serially(function, items)
    call, turn, results = _checked(function), itertools.count(), [None] * len(items)

    def work() -> bool:
        while (k := next(turn)) < len(items):
            results[k] = call(*items[k])
        return False  # what the others have begun is not known

    _on_threads(threads, work, ())
    return results


def run_together(work: Callable[..., bool], arguments: tuple) -> None:
    """Call `work(*arguments)` on the caller's thread and on the pool's, as `run_parallel` does.

    Each call takes parts of the work until none is left, and returns whether all parts are done. Only if not, because
    another thread still has one, the caller sleeps until it has: to be woken up takes as long as a small part.
    """
    _on_threads(threads_to_use(), _checked(work), arguments)


def _on_threads(threads: int, work: Callable[..., bool], arguments: tuple) -> None:
    """`work(*arguments)` on so many; where the caller's doesn't say that all is done, what has begun is waited for."""
    helpers = [_shared_pool().submit(work, *arguments) for _ in range(threads - 1)]
    done = False
    try:
        done = work(*arguments)
    finally:
        begun = [helper for helper in helpers if not helper.cancel()]
        if not done:
            wait(begun)
    if not done:
        for helper in begun:
            helper.result()


def run_serially(function: Callable[..., Any], items: Sequence[tuple]) -> list[Any]:
    """As `run_parallel`, one after the other: waking a thread up takes longer than some items."""
    call = _checked(function)
    return [call(*item) for item in items]


def _checked(function: Callable[..., Any]) -> Callable[..., Any]:
    check = _check.get()
    if check is None:
        return function

    def call(*item: Any) -> Any:
        check()
        return function(*item)

    return call


def _count_callers(more: int) -> None:
    global _callers
    with _lock:
        _callers += more


def split_evenly(count: int, parts: int) -> list[tuple[int, int]]:
    """`parts` or fewer consecutive, non-empty (start, stop) ranges that cover `range(count)`."""
    parts = max(1, min(parts, count))
    edges = [count * part // parts for part in range(parts + 1)]
    return [(start, stop) for start, stop in itertools.pairwise(edges) if stop > start]


def _shared_pool() -> ThreadPoolExecutor:
    global _pool
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(thread_count(), thread_name_prefix="msdgs")
        return _pool


def _forget_pool() -> None:
    """A forked child has none of its parent's threads, and perhaps a lock that nobody will release."""
    global _pool, _lock, _callers
    _pool, _lock, _callers = None, threading.Lock(), 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)
