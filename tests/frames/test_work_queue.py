"""Places in the queue of renders: given on arrival, gone over to the work, back when that is done."""

import asyncio
import contextvars
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from msdgs_serve.api.errors import RequestRejected
from msdgs_serve.api.work import WorkQueue
from msdgs_serve.render_job import RenderJob


@pytest.fixture
def queue() -> Iterator[WorkQueue]:
    """Two places: one piece of work at once, and one in line."""
    queue = WorkQueue(workers=1, waiting=1, seconds=20)
    yield queue
    queue.shut_down()


def is_full(queue: WorkQueue) -> bool:
    try:
        with queue.admitted("another"):
            return False
    except RequestRejected:
        return True


def test_calls_have_their_places_before_they_have_any_work(queue: WorkQueue):
    with ExitStack() as calls:
        calls.enter_context(queue.admitted("one"))
        assert not is_full(queue)
        calls.enter_context(queue.admitted("two"))
        assert is_full(queue)
        assert queue.waiting == 2
    assert not is_full(queue), "calls that had no work give their places back"
    assert queue.waiting == 0


def test_a_place_is_free_when_the_work_is_done_though_its_answer_is_still_sent(queue: WorkQueue):
    async def call() -> None:
        with queue.admitted("one"), queue.admitted("two"):
            assert is_full(queue)
            await queue.run(lambda: None, RenderJob())
            while queue.waiting > 1:  # the future is done a moment before its callbacks have run
                await asyncio.sleep(0.001)
            assert not is_full(queue)

    asyncio.run(call())


def test_later_work_of_a_call_is_never_refused(queue: WorkQueue):
    async def call() -> bool:
        with queue.admitted("three"):
            await queue.run(lambda: None, RenderJob())
            while queue.waiting:
                await asyncio.sleep(0.001)
            with queue.admitted("one"), queue.admitted("two"):
                return await queue.run(lambda: is_full(queue), RenderJob())

    assert asyncio.run(call())


def test_work_of_a_call_that_was_not_admitted_is_refused_where_all_places_are_taken(queue: WorkQueue):
    async def work() -> None:
        with pytest.raises(RequestRejected):
            await queue.run(lambda: None, RenderJob())

    with queue.admitted("one"), queue.admitted("two"):
        contextvars.Context().run(lambda: asyncio.run(work()))
