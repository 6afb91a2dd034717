"""The queue of renders: bounded, fair, with a time limit for each, and without work for clients that are gone."""

import asyncio
import math
import threading
import time
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any, TypeVar

from starlette.requests import Request

from msdgs_serve.api.errors import ClientGone, RequestRejected
from msdgs_serve.api.turns import Turns
from msdgs_serve.render_job import RenderJob
from msdgs_serve.threads import lower_priority

Result = TypeVar("Result")

MAX_RETRY_SECONDS = 60
FIRST_GUESS = 0.5  # seconds a piece of work takes, until one was measured
SMOOTHING = 0.1
UNKNOWN = "unknown"


@dataclass(eq=False)
class _Call:
    """One that was admitted, or will be where it has work."""

    client: str
    streamed: bool
    has_place: bool = False
    future: Future[Any] | None = None  # of its last piece of work


@dataclass(eq=False)
class _Piece:
    """Work in line."""

    future: Future[Any]
    work: Callable[[], Any]

    def do(self) -> None:
        """Unless nobody waits for it."""
        if self.future.set_running_or_notify_cancel():
            try:
                result = self.work()
            except BaseException as error:
                self.future.set_exception(error)
            else:
                self.future.set_result(result)


_call: ContextVar[_Call | None] = ContextVar("call", default=None)


class WorkQueue:
    """`workers` pieces of work at once and places for `waiting` more calls; what comes on top is refused.

    A client has at most as many places as it leaves free, and streamed calls, whose work comes in parts, have at most
    half of all. Whose work is done next: see `Turns`.
    """

    def __init__(self, workers: int, waiting: int, seconds: float) -> None:
        self._workers = workers
        self._places = workers + waiting
        self._seconds = seconds
        self._executor = ThreadPoolExecutor(workers, "render", initializer=lower_priority)
        self._lock = threading.Lock()
        self._turns: Turns[_Piece] = Turns()
        self._held: Counter[str] = Counter()  # places by client
        self._streams = 0  # places of streamed calls
        self._running = 0
        self._mean_seconds = FIRST_GUESS
        self._closed = False

    @property
    def waiting(self) -> int:
        """Places that are taken, and whose work isn't being done yet."""
        return max(0, self._held.total() - self._running)

    @property
    def running(self) -> int:
        """Pieces of work being done."""
        return self._running

    @contextmanager
    def admitted(self, client: str, *, streamed: bool = False, at_once: bool = True) -> Iterator[None]:
        """Around a call: it has a place from now, or unless `at_once` from its first work, until that is done.

        A streamed call has its place to the end, and no later work of any call is refused. Raises `RequestRejected` where there
        is no place for it.
        """
        call = _Call(client, streamed)
        if at_once:
            with self._lock:
                self._take_place(call)
        token = _call.set(call)
        try:
            yield
        finally:
            _call.reset(token)
            if call.future is None or call.future.done():
                self._leave(call)
            else:
                call.future.add_done_callback(lambda _: self._leave(call))

    def reject_if_full(self, client: str) -> None:
        """Raise `RequestRejected` where a call that isn't streamed would not be admitted now."""
        with self._lock:
            self._reject_if_full(client)

    def close(self) -> None:
        """Refuse new work; what is there is finished."""
        self._closed = True

    def shut_down(self) -> None:
        """Let go of the threads; what has not begun never will."""
        self.close()
        self._executor.shutdown(wait=False, cancel_futures=True)

    async def run(self, work: Callable[[], Result], job: RenderJob, *, part: bool = False) -> Result:
        """Do `work` when its turn comes; where the call wasn't admitted before, it may be refused here.

        `part`: of work that goes on, so that the call keeps its place; single frames of others come in between. Whoever
        awaits this may be cancelled: work that waits is dropped, and work that runs is ended by its job.

        Raises:
            RequestRejected: with 503 where the queue is full or closed, with 504 when the time is over.
        """
        piece = self._submit(work, job, part=part)
        waiter = asyncio.wrap_future(piece.future)
        waiter.add_done_callback(lambda done: done.cancelled() or done.exception())  # nobody may be left to look
        try:
            async with asyncio.timeout(self._seconds):
                return await asyncio.shield(waiter)
        except TimeoutError:
            detail = f"It took longer than {self._seconds:g} s, the time limit of a request."
            raise RequestRejected(HTTPStatus.GATEWAY_TIMEOUT, "deadline", detail) from None
        finally:
            if not piece.future.done():
                job.cancel()
                if piece.future.cancel():
                    with self._lock:
                        self._turns.remove(piece)

    def _submit(self, work: Callable[[], Result], job: RenderJob, *, part: bool) -> _Piece:
        submitted = time.perf_counter()
        admitted = _call.get()
        call = admitted or _Call(UNKNOWN, streamed=False)

        def timed() -> Result:
            started = time.perf_counter()
            job.add("queue", started - submitted)
            with self._lock:
                self._running += 1
            try:
                job.check()
                return work()
            finally:
                with self._lock:
                    self._running -= 1
                    self._mean_seconds += SMOOTHING * (time.perf_counter() - started - self._mean_seconds)

        piece = _Piece(Future(), timed)
        with self._lock:
            if not call.has_place:
                self._take_place(call, again=call.future is not None)
            call.future = piece.future
            self._turns.add(piece, call.client, part=part)
        if admitted is None or not (part or call.streamed):
            piece.future.add_done_callback(lambda _: self._leave(call))
        self._executor.submit(self._do_next)
        return piece

    def _do_next(self) -> None:
        with self._lock:
            piece = self._turns.next()
        if piece is not None:
            piece.do()

    def _take_place(self, call: _Call, *, again: bool = False) -> None:
        if not again:
            self._reject_if_full(call.client, streamed=call.streamed)
        self._held[call.client] += 1
        self._streams += call.streamed
        call.has_place = True

    def _leave(self, call: _Call) -> None:
        with self._lock:
            if call.has_place:
                call.has_place = False
                self._streams -= call.streamed
                self._held[call.client] -= 1
                if not self._held[call.client]:
                    del self._held[call.client]

    def _reject_if_full(self, client: str, *, streamed: bool = False) -> None:
        if self._closed:
            detail = "The service is about to stop; ask again, another one may answer."
            raise RequestRejected(HTTPStatus.SERVICE_UNAVAILABLE, "draining", detail, retry_after=1)
        taken = self._held.total()
        if taken >= self._places:
            detail = f"All {self._places} places for work and in the queue are taken; try again later."
        elif self._held[client] >= self._places - taken:
            detail = f"You have {self._held[client]} places for work and in the queue, as many as are left for others."
        elif streamed and self._streams >= max(1, self._places // 2):
            detail = f"All {self._streams} places for batches and films are taken; try again later."
        else:
            return
        seconds = math.ceil(taken * self._mean_seconds / self._workers)
        retry_after = min(max(1, seconds), MAX_RETRY_SECONDS)
        raise RequestRejected(HTTPStatus.SERVICE_UNAVAILABLE, "overloaded", detail, retry_after=retry_after)


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
