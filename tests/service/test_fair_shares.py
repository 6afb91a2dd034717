"""Places in the queue by client, when they are released, and the order of work."""

import asyncio
import contextvars
import threading
import weakref
from collections.abc import AsyncGenerator, Iterator
from contextlib import ExitStack, aclosing
from pathlib import Path
from typing import Any

import httpx
import pytest

from msdgs_serve.api.app import create_app
from msdgs_serve.api.errors import RequestRejected
from msdgs_serve.api.routes import batch, video
from msdgs_serve.api.schemas import VideoRequest
from msdgs_serve.api.server import Server
from msdgs_serve.api.service import Service
from msdgs_serve.api.settings import Settings
from msdgs_serve.api.turns import PART_INTERVAL, Turns
from msdgs_serve.api.work import WorkQueue
from msdgs_serve.imaging import Image
from msdgs_serve.render_job import RenderJob
from msdgs_serve.renderer import Renderer
from msdgs_serve.store import SceneStore
from tests.support.service import FRAME, ORBIT, eventually, in_this_process, serving

MANY = 40


def order(turns: Turns[str]) -> list[str]:
    return list(iter(turns.next, None))


def test_clients_take_turns():
    turns: Turns[str] = Turns()
    for item in ("a1", "a2", "a3", "b1", "c1", "b2"):
        turns.add(item, item[0], part=False)
    assert order(turns) == ["a1", "b1", "c1", "a2", "b2", "a3"]
    assert turns.next() is None


def test_single_frames_come_in_between_parts_which_have_their_turns_too():
    turns: Turns[str] = Turns()
    for number in range(3):
        turns.add(f"part of {number}", str(number), part=True)
    for _ in range(2 * PART_INTERVAL):
        turns.add("single", "x", part=False)
    done = order(turns)
    assert done[: 2 * PART_INTERVAL] == ["single"] * (PART_INTERVAL - 1) + ["part of 0"] + ["single"] * (
        PART_INTERVAL - 1
    ) + ["part of 1"]
    assert done[2 * PART_INTERVAL :] == ["single", "single", "part of 2"]


@pytest.fixture
def queue() -> Iterator[WorkQueue]:
    queue = WorkQueue(workers=2, waiting=6, seconds=20)
    yield queue
    queue.shut_down()


def taken(queue: WorkQueue) -> int:
    return queue._held.total()


def places(queue: WorkQueue, calls: ExitStack, client: str, *, streamed: bool = False) -> int:
    """Return how many places a client gets before it is rejected."""
    before = taken(queue)

    def take_all() -> None:
        while True:
            calls.enter_context(queue.admitted(client, streamed=streamed))

    with pytest.raises(RequestRejected, match="places") as refused:
        take_all()
    assert (refused.value.status, refused.value.headers["Retry-After"].isdecimal()) == (503, True)
    return taken(queue) - before


def test_a_client_has_as_many_places_as_it_leaves(queue: WorkQueue):
    with ExitStack() as calls:
        assert [places(queue, calls, client) for client in ("one", "two", "three", "four")] == [4, 2, 1, 1]
        assert (taken(queue), queue.waiting) == (8, 0), "calls without work don't wait"
    assert taken(queue) == 0
    with ExitStack() as calls:
        assert places(queue, calls, "four") == 4


def test_batches_and_videos_have_half_of_all_places(queue: WorkQueue):
    with ExitStack() as calls:
        assert [places(queue, calls, client, streamed=True) for client in ("one", "two", "three")] == [2, 1, 1]
        assert places(queue, calls, "four", streamed=True) == 0
        assert places(queue, calls, "four") == 2
    with ExitStack() as calls:
        for client in ("one", "two", "three"):
            calls.enter_context(queue.admitted(client, streamed=True))
        assert places(queue, calls, "four", streamed=True) == 1


def test_parts_keep_their_place_until_the_call_and_its_work_have_ended(queue: WorkQueue):
    begun, go_on = threading.Event(), threading.Event()

    async def call() -> None:
        with queue.admitted("one", streamed=True):
            await queue.run(lambda: None, RenderJob(), part=True)
            assert (taken(queue), queue.waiting) == (1, 0)
            last = asyncio.ensure_future(queue.run(lambda: begun.set() or go_on.wait(20), RenderJob(), part=True))
            assert await asyncio.to_thread(begun.wait, 20)
        last.cancel()
        assert queue.running == 1
        with ExitStack() as calls:
            assert places(queue, calls, "one") == 3, "one of four places is taken until the thread is free"
        go_on.set()

    asyncio.run(call())
    queue.shut_down()
    queue._executor.shutdown(wait=True)
    assert taken(queue) == queue.running == 0


def fill(queue: WorkQueue, calls: ExitStack) -> None:
    assert sum(places(queue, calls, client) for client in ("two", "three", "four", "five")) == taken(queue) == 8


def test_the_place_of_a_call_is_free_after_its_work_and_later_work_is_never_refused(queue: WorkQueue):
    async def call() -> None:
        with queue.admitted("one"), ExitStack() as calls:
            await queue.run(lambda: None, RenderJob())
            while taken(queue):  # callbacks run shortly after the future is done
                await asyncio.sleep(0.001)
            fill(queue, calls)
            await queue.run(lambda: None, RenderJob())

    asyncio.run(call())


def test_work_of_a_call_that_was_not_admitted_is_refused_where_all_places_are_taken(queue: WorkQueue):
    async def work() -> None:
        with pytest.raises(RequestRejected):
            await queue.run(lambda: None, RenderJob())

    with ExitStack() as calls:
        fill(queue, calls)
        contextvars.Context().run(lambda: asyncio.run(work()))


@pytest.fixture
def service(scene: Path) -> Iterator[Service]:
    app = create_app(SceneStore([scene]), Renderer(), Settings(scenes=[scene], max_batch=MANY))
    yield app.state.service
    app.state.service.queue.shut_down()


@pytest.fixture
def images(service: Service, monkeypatch: pytest.MonkeyPatch) -> list[weakref.ref[Image]]:
    drawn: list[weakref.ref[Image]] = []
    original = service.renderer.render

    def render(*arguments: Any) -> Image:
        image = original(*arguments)
        drawn.append(weakref.ref(image))
        return image

    monkeypatch.setattr(service.renderer, "render", render)
    return drawn


def times(count: int) -> list[float]:
    return [number / count for number in range(count)]


def streamed_video(service: Service) -> AsyncGenerator[bytes]:
    frames = [{"camera": ORBIT, "t": t} for t in times(MANY)]
    body = VideoRequest.model_validate({"frames": frames, "width": 32, "height": 32})
    return video._stream_video(service, body, *video._path(service, body))


def lines(service: Service) -> AsyncGenerator[Any]:
    return batch._items(service, [{**FRAME, "t": t} for t in times(MANY)], multipart=False)


@pytest.mark.parametrize("made", [streamed_video, lines])
def test_frames_are_drawn_as_they_are_sent_and_not_kept(service: Service, images: list[weakref.ref[Image]], made: Any):
    """A video or batch has one frame in memory, and renders none before the previous one is sent."""

    async def take() -> None:
        taken = 0
        async with aclosing(made(service)) as pieces:
            async for _ in pieces:
                taken += 1
                assert len(images) == min(taken, MANY)
                assert sum(image() is not None for image in images) <= 1

    asyncio.run(take())
    assert len(images) == MANY


def test_a_video_fails_before_its_first_byte_or_is_cut_off(scene: Path):
    renderer = Renderer()
    original, broken = renderer.render, list[float]()

    def render(*arguments: Any) -> Image:
        if arguments[2] in broken:
            raise RuntimeError("secret")
        return original(*arguments)

    renderer.render = render  # pyright: ignore[reportAttributeAccessIssue]
    frames = [{"camera": ORBIT, "t": t} for t in (0.0, 0.5, 1.0)]
    with serving(scene, renderer=renderer) as client:
        body = {"frames": frames, "width": 16, "height": 16}
        broken[:] = [0.0]
        broken_at_once = client.post("/render/video", json=body)
        assert broken_at_once.status_code == 500
        assert "secret" not in broken_at_once.text
        broken[:] = [1.0]
        with pytest.raises(httpx.RemoteProtocolError):
            client.post("/render/video", json=body)
        eventually(lambda: 'msdgs_problems_total{kind="internal"} 2.0\n' in client.get("/metrics").text)
        broken[:] = []
        assert client.post("/render/video", json=body).status_code == 200


@in_this_process
@pytest.mark.parametrize("path", ["/render/batch", "/render/video"])
def test_a_batch_or_video_needs_a_place_at_once_whatever_its_client_has(scene: Path, path: str):
    servers: list[Server] = []
    with serving(scene, server=servers, concurrent_renders=1, queued_renders=0) as client:
        with servers[0].service.queue.admitted("other"):
            assert client.post(path, json={}, headers={"If-None-Match": '"x"'}).status_code == 503
        assert client.post(path, json={}, headers={"If-None-Match": '"x"'}).status_code == 422


@in_this_process
def test_a_list_of_times_is_drawn_in_parts(scene: Path):
    """Otherwise one request would occupy a thread for all of its frames."""
    servers: list[Server] = []
    with serving(scene, server=servers) as client:
        queue, parts = servers[0].service.queue, []
        original = queue.run

        async def run(work: Any, job: RenderJob, *, part: bool = False) -> Any:
            parts.append(part)
            return await original(work, job, part=part)

        queue.run = run  # pyright: ignore[reportAttributeAccessIssue]
        response = client.post("/render", json={**FRAME, "t": [0.0, 0.5, 1.0], "format": "npy"})
        assert response.status_code == 200
    assert parts == [True] * 4
