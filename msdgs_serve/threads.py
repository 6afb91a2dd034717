"""One thread pool for the process, shared by kernels and onnxruntime calls, with one thread per core.

numba's own parallel layers abort when two threads enter them or when the process forks; threads that run nogil kernels
don't.
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

from msdgs_serve.scene import InvalidInput

THREADS_VARIABLE = "MSDGS_THREADS"
NICENESS = 10
"""Niceness of render threads: under overload /live is answered in a quarter of the time or less; a niceness of 5 gains
less."""

_check: ContextVar[Callable[[], object] | None] = ContextVar("check", default=None)
_lock = threading.Lock()
_pool: ThreadPoolExecutor | None = None
_callers = 0  # number of callers within `sharing_cores`


def thread_count() -> int:
    """Return the size of the pool: `MSDGS_THREADS`, or the cores this process may use, read once.

    Raises `InvalidInput` naming the variable.
    """
    setting = os.environ.get(THREADS_VARIABLE)
    if not setting:
        return _cores()
    if not setting.isdecimal() or int(setting) < 1:
        raise InvalidInput(THREADS_VARIABLE, "a whole number above 0", repr(setting))
    return int(setting)


@cache
def _cores() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def checking(check: Callable[[], object]) -> Iterator[None]:
    """Within the context, `run_parallel` and `run_serially` call `check` before every item; its exception ends them."""
    token = _check.set(check)
    try:
        yield
    finally:
        _check.reset(token)


def lower_priority() -> None:
    """Lower the priority of this thread and of threads that it starts (Linux).

    Otherwise short requests wait for a core while all cores render.
    """
    if sys.platform == "linux":  # elsewhere priorities are per process
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), NICENESS)


@contextmanager
def sharing_cores() -> Iterator[None]:
    """Mark the computation of one caller. If there are several callers at once, each computes on its own thread.

    One frame per core is faster than sharing cores (1.04 times as many frames per second from 8 clients), since each
    parallel part waits for Python's interpreter once more.
    """
    _count_callers(1)
    try:
        yield
    finally:
        _count_callers(-1)


def threads_to_use() -> int:
    """Return into how many parts to split work now: `thread_count()`, or 1 if several callers compute at once."""
    return thread_count() if _callers <= 1 else 1


def run_parallel(function: Callable[..., Any], items: Sequence[tuple]) -> list[Any]:
    """Call `function(*item)` for every item, and return the results in order.

    Runs on the caller's thread and the pool's, or on the caller's alone if several callers compute at once. The first
    exception is raised after all started calls have ended. Must not be called from inside the pool.
    """
    threads = min(threads_to_use(), len(items)) if len(items) > 1 else 1
    if threads <= 1:
        return run_serially(function, items)
    call, turn, results = _checked(function), itertools.count(), [None] * len(items)

    def work() -> bool:
        while (k := next(turn)) < len(items):
            results[k] = call(*items[k])
        return False  # other threads may still be working

    _on_threads(threads, work, ())
    return results


def run_together(work: Callable[..., bool], arguments: tuple) -> None:
    """Call `work(*arguments)` on the caller's thread and on the pool's, as `run_parallel` does.

    Each call takes parts of the work until none is left, and returns whether all parts are done. The caller sleeps only
    if another thread still works on one, since waking up takes as long as a small part.
    """
    _on_threads(threads_to_use(), _checked(work), arguments)


def _on_threads(threads: int, work: Callable[..., bool], arguments: tuple) -> None:
    """Call `work(*arguments)` on several threads; unless the caller's call returns True, wait for the others."""
    helpers = [_shared_pool().submit(work, *arguments) for _ in range(threads - 1)]
    done = False
    try:
        done = work(*arguments)
    finally:
        started = [helper for helper in helpers if not helper.cancel()]
        if not done:
            wait(started)
    if not done:
        for helper in started:
            helper.result()


def run_serially(function: Callable[..., Any], items: Sequence[tuple]) -> list[Any]:
    """Call `function(*item)` for every item on the caller's thread: waking up a thread takes longer than short
    items."""
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


def _count_callers(change: int) -> None:
    global _callers
    with _lock:
        _callers += change


def split_evenly(count: int, parts: int) -> list[tuple[int, int]]:
    """Return at most `parts` consecutive, non-empty (start, stop) ranges that cover `range(count)`."""
    parts = max(1, min(parts, count))
    edges = [count * part // parts for part in range(parts + 1)]
    return [(start, stop) for start, stop in itertools.pairwise(edges) if stop > start]


def _shared_pool() -> ThreadPoolExecutor:
    global _pool
    with _lock:
        if _pool is None:
            _pool = ThreadPoolExecutor(thread_count(), thread_name_prefix="msdgs")
        return _pool


def _reset_pool() -> None:
    """Reset the pool in a forked child, which has no threads and may have inherited a locked lock."""
    global _pool, _lock, _callers
    _pool, _lock, _callers = None, threading.Lock(), 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_reset_pool)
