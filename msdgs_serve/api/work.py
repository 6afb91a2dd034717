"""The render queue: bounded, fair between clients, with a time limit, and cancelled when a client disconnects."""

import asyncio
import math
import sys
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
    """A call that is admitted, or will be with its first work."""

    client: str
    streamed: bool
    has_place: bool = False
    future: Future[Any] | None = None  # of its latest work


@dataclass(eq=False)
class _Piece:
    """A piece of waiting work."""

    future: Future[Any]
    work: Callable[[], Any]

    def do(self) -> None:
        """Run the work, unless it was cancelled."""
        if self.future.set_running_or_notify_cancel():
            try:
                result = self.work()
            except BaseException as error:
                self.future.set_exception(error)
            else:
                self.future.set_result(result)


_call: ContextVar[_Call | None] = ContextVar("call", default=None)


class WorkQueue:
    """Runs `workers` pieces of work at once, with places for `waiting` more calls; further calls are rejected.

    Streamed calls, whose work has several parts, hold at most half of all places. A client may hold at most as many
    places as are left for others, also of those for streamed calls. `Turns` decides the order.

    Calls are also rejected while clients haven't read `max_unread` bytes of responses, and calls of a client that has
    as many unread bytes as are left for others.
    """

    def __init__(self, workers: int, waiting: int, seconds: float, max_unread: int = sys.maxsize) -> None:
        self._workers = workers
        self._places = workers + waiting
        self._seconds = seconds
        self._max_unread = max_unread
        self.unread: Callable[[], Counter[str]] = Counter
        """Returns the unread bytes by client; set by the server that holds them."""
        self._executor = ThreadPoolExecutor(workers, "render", initializer=lower_priority)
        self._lock = threading.Lock()
        self._turns: Turns[_Piece] = Turns()
        self._held: Counter[str] = Counter()  # places by client
        self._streams: Counter[str] = Counter()  # those of streamed calls
        self._running = 0
        self._mean_seconds = FIRST_GUESS
        self._closed = False

    @property
    def waiting(self) -> int:
        """Number of pieces of work that wait for their turn."""
        with self._lock:
            return len(self._turns)

    @property
    def running(self) -> int:
        """Number of running pieces of work."""
        return self._running

    @contextmanager
    def admitted(self, client: str, *, streamed: bool = False, at_once: bool = True) -> Iterator[None]:
        """Hold a place for a call within the context, from now if `at_once`, else from its first work, until it ends.

        A streamed call holds its place to the end; later work of an admitted call is never rejected. Raises
        `RequestRejected` if there is no place.
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

    def close(self) -> None:
        """Reject new calls, and finish admitted ones."""
        self._closed = True

    def shut_down(self) -> None:
        """Stop the threads and drop waiting work."""
        self.close()
        self._executor.shutdown(wait=False, cancel_futures=True)

    async def run(self, work: Callable[[], Result], job: RenderJob, *, part: bool = False) -> Result:
        """Run `work` when its turn comes, and return its result. A call that isn't admitted yet may be rejected.

        `part` is set for work that has further parts, so that the call keeps its place; single frames of others come in
        between. If the caller is cancelled, waiting work is dropped and running work is cancelled through its job.

        Raises:
            RequestRejected: with 503 if the queue is full or closed, with 504 after the time limit.
        """
        piece = self._submit(work, job, part=part)
        waiter = asyncio.wrap_future(piece.future)
        waiter.add_done_callback(lambda done: done.cancelled() or done.exception())  # it may never be awaited
        try:
            async with asyncio.timeout(self._seconds):
                return await asyncio.shield(waiter)
        except TimeoutError:
            detail = f"The request took longer than its time limit of {self._seconds:g} s."
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
                self._take_place(call, admitted_before=call.future is not None)
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

    def _take_place(self, call: _Call, *, admitted_before: bool = False) -> None:
        if not admitted_before:
            self._reject_if_full(call)
        for places in self._places_of(call):
            places[call.client] += 1
        call.has_place = True

    def _leave(self, call: _Call) -> None:
        with self._lock:
            if call.has_place:
                call.has_place = False
                for places in self._places_of(call):
                    places[call.client] -= 1
                    if not places[call.client]:
                        del places[call.client]

    def _places_of(self, call: _Call) -> list[Counter[str]]:
        return [self._held, self._streams] if call.streamed else [self._held]

    def _reject_if_full(self, call: _Call) -> None:
        if self._closed:
            detail = "The service is stopping; try again, another instance may answer."
            raise RequestRejected(HTTPStatus.SERVICE_UNAVAILABLE, "draining", detail, retry_after=1)
        detail = _refusal(self._held, call.client, self._places, "work and in the queue")
        if detail is None and call.streamed:
            detail = _refusal(self._streams, call.client, max(1, self._places // 2), "batches and videos")
        if detail is None:
            detail = _refusal_of_unread(self.unread(), call.client, self._max_unread)
        if detail is None:
            return
        seconds = math.ceil(self._held.total() * self._mean_seconds / self._workers)
        retry_after = min(max(1, seconds), MAX_RETRY_SECONDS)
        raise RequestRejected(HTTPStatus.SERVICE_UNAVAILABLE, "overloaded", detail, retry_after=retry_after)


def _refusal(held: Counter[str], client: str, places: int, purpose: str) -> str | None:
    """Return why a client gets none of the places, or None if it gets one."""
    left = places - held.total()
    if left <= 0:
        return f"All {places} places for {purpose} are taken; try again later."
    if held[client] >= left:
        return f"You have {held[client]} places for {purpose}, as many as are left for others."
    return None


def _refusal_of_unread(unread: Counter[str], client: str, limit: int) -> str | None:
    """Return why a client gets no response before others are read, or None if it gets one."""
    left = limit - unread.total()
    if left <= 0:
        return "The memory for responses is taken by those that clients haven't read yet; try again later."
    if unread[client] >= left:
        return f"You haven't read {unread[client]} bytes of responses, as many as are left for others."
    return None


async def unless_gone(request: Request, call: Awaitable[Result]) -> Result:
    """Return the result of `call`, or cancel it and raise `ClientGone` if the client disconnects first.

    The body of the request must have been read.
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
