"""The queue of renders: bounded, with a time limit for each, and without work for clients that are gone."""

import asyncio
import math
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from http import HTTPStatus
from typing import TypeVar

from starlette.requests import Request

from msdgs_serve.api.errors import ClientGone, Refused
from msdgs_serve.threads import give_way
from msdgs_serve.watch import Watch

Result = TypeVar("Result")

LONGEST_RETRY = 60
FIRST_GUESS = 0.5  # seconds a piece of work takes, until one was measured
SMOOTHING = 0.1


@dataclass
class _Call:
    """One that was admitted."""

    has_place: bool = True  # which goes over to its first piece of work


_admitted: ContextVar[_Call | None] = ContextVar("admitted", default=None)


class WorkQueue:
    """`workers` pieces of work at once and places for `waiting` more in line; what comes on top is refused."""

    def __init__(self, workers: int, waiting: int, seconds: float) -> None:
        self._workers = workers
        self._places = workers + waiting
        self._seconds = seconds
        self._executor = ThreadPoolExecutor(workers, "render", initializer=give_way)
        self._lock = threading.Lock()
        self._taken = 0
        self._running = 0
        self._mean_seconds = FIRST_GUESS
        self._closed = False

    @property
    def waiting(self) -> int:
        """Places that are taken, and whose work isn't being done yet."""
        return max(0, self._taken - self._running)

    @property
    def running(self) -> int:
        """Pieces of work being done."""
        return self._running

    @contextmanager
    def admitted(self) -> Iterator[None]:
        """Around a call: it has a place from now until its first work is done, and later work of it is never refused.

        Raises `Refused` where all places are taken.
        """
        with self._lock:
            self._refuse_if_full()
            self._taken += 1
        call = _Call()
        token = _admitted.set(call)
        try:
            yield
        finally:
            _admitted.reset(token)
            if call.has_place:
                self._leave()

    def refuse_if_full(self) -> None:
        """Raise `Refused` where a call would not be admitted now."""
        with self._lock:
            self._refuse_if_full()

    def close(self) -> None:
        """Refuse new work; what is there is finished."""
        self._closed = True

    def shut_down(self) -> None:
        """Let go of the threads; what has not begun never will."""
        self.close()
        self._executor.shutdown(wait=False, cancel_futures=True)

    async def run(self, work: Callable[[], Result], watch: Watch) -> Result:
        """Do `work` when its turn comes; where the call wasn't admitted before, it may be refused here.

        Whoever awaits this may be cancelled: work that waits is dropped, and work that runs is ended by its watch.

        Raises:
            Refused: with 503 where the queue is full or closed, with 504 when the time is over.
        """
        future = self._submit(work, watch)
        waiter = asyncio.wrap_future(future)
        waiter.add_done_callback(lambda done: done.cancelled() or done.exception())  # nobody may be left to look
        try:
            async with asyncio.timeout(self._seconds):
                return await asyncio.shield(waiter)
        except TimeoutError:
            detail = f"It took longer than {self._seconds:g} s, the time limit of a request."
            raise Refused(HTTPStatus.GATEWAY_TIMEOUT, "deadline", detail) from None
        finally:
            if not future.done():
                watch.stop()
                future.cancel()

    def _submit(self, work: Callable[[], Result], watch: Watch) -> Future[Result]:
        submitted = time.perf_counter()

        def timed() -> Result:
            started = time.perf_counter()
            watch.add("queue", started - submitted)
            with self._lock:
                self._running += 1
            try:
                watch.check()
                return work()
            finally:
                with self._lock:
                    self._running -= 1
                    self._mean_seconds += SMOOTHING * (time.perf_counter() - started - self._mean_seconds)

        self._take_place(_admitted.get())
        future = self._executor.submit(timed)
        future.add_done_callback(lambda _: self._leave())
        return future

    def _take_place(self, call: _Call | None) -> None:
        with self._lock:
            if call is not None and call.has_place:
                call.has_place = False
                return
            if call is None:
                self._refuse_if_full()
            self._taken += 1

    def _leave(self) -> None:
        with self._lock:
            self._taken -= 1

    def _refuse_if_full(self) -> None:
        if self._closed:
            detail = "The service is about to stop; ask again, another one may answer."
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, "draining", detail, retry_after=1)
        if self._taken >= self._places:
            seconds = math.ceil(self._taken * self._mean_seconds / self._workers)
            detail = f"All {self._places} places for work and in the queue are taken; try again later."
            retry_after = min(max(1, seconds), LONGEST_RETRY)
            raise Refused(HTTPStatus.SERVICE_UNAVAILABLE, "overloaded", detail, retry_after=retry_after)


async def unless_gone(request: Request, call: Awaitable[Result]) -> Result:
    """The result of `call`; where the client closes the connection first, `call` is cancelled.

    The body of the request must have been read. Raises `ClientGone`.
    """
    task = asyncio.ensure_future(call)
    gone = asyncio.ensure_future(_disconnection(request))
    try:
        await asyncio.wait({task, gone}, return_when=asyncio.FIRST_COMPLETED)
        if not task.done():
            raise ClientGone("the client closed the connection")
        return task.result()
    finally:
        for each in (task, gone):
            each.cancel()


async def _disconnection(request: Request) -> None:
    while (await request.receive())["type"] != "http.disconnect":
        pass
