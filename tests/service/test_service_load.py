"""Overload: requests beyond the queue are rejected at once with Retry-After, and accepted ones are finished."""

import contextlib
import json
import math
import signal
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest

from msdgs_serve.api.server import Server
from msdgs_serve.deformation import DeformationSession
from msdgs_serve.pose_cache import PoseCache
from msdgs_serve.render_job import RenderCancelled, RenderJob
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene import Gaussians
from tests.support.service import FRAME, MAX_SECONDS, check_problem, connect, eventually, serving

pytestmark = pytest.mark.slow


class SlowPoses(PoseCache):
    """A cache that stores no poses; once `slow` is set, each pose waits for `go_on`.

    From pose number `last` on, each then waits until its request is cancelled.
    """

    def __init__(self) -> None:
        super().__init__(0)
        self.slow = False
        self.go_on = threading.Event()
        self.begun = 0
        self.last = math.inf

    def get(self, session: DeformationSession, t: float, job: RenderJob, steps: float | None = None) -> Gaussians:
        job.check()
        if self.slow:
            self.begun += 1
            assert self.go_on.wait(MAX_SECONDS)
            if self.begun >= self.last:
                eventually(lambda: is_cancelled(job))
        return session.gaussians(t)


@pytest.fixture
def poses() -> Iterator[SlowPoses]:
    poses = SlowPoses()
    yield poses
    poses.go_on.set()


@contextlib.contextmanager
def serving_slowly(scene: Path, poses: SlowPoses, **settings: Any) -> Iterator[tuple[httpx.Client, Server]]:
    """A client of a service that is slow from now on, and its server."""
    renderer, servers = Renderer(), list[Server]()
    renderer.cache = poses
    with serving(scene, renderer=renderer, server=servers, **settings) as client:
        poses.slow = True
        yield client, servers[0]


def is_cancelled(job: RenderJob) -> bool:
    try:
        job.check()
    except RenderCancelled:
        return True
    return False


def test_requests_beyond_the_queue_are_rejected_with_retry_after(scene: Path, poses: SlowPoses):
    with (
        serving_slowly(scene, poses, concurrent_renders=2, queued_renders=3) as (client, server),
        ThreadPoolExecutor(5) as pool,
    ):
        queue = server.service.queue

        def ask(number: int) -> httpx.Response:
            """Send a request as the client of an address, which a proxy names."""
            return client.post("/render", json=FRAME, headers={"X-Forwarded-For": f"10.0.0.{number}"})

        def check_refused(response: httpx.Response) -> None:
            check_problem(response, 503)
            assert 1 <= int(response.headers["Retry-After"]) <= 60

        accepted = [pool.submit(ask, 0) for _ in range(3)]
        eventually(lambda: (queue.running, queue.waiting) == (2, 1))
        refused = ask(0)
        check_refused(refused)
        assert "3 places" in refused.json()["detail"], "the share of one client"
        accepted += [pool.submit(ask, number) for number in (1, 2)]
        eventually(lambda: (queue.running, queue.waiting) == (2, 3))
        for _ in range(3):
            check_refused(client.post("/render", json=FRAME))
        assert client.post("/render/batch", json={"frames": [FRAME]}).status_code == 503
        assert client.post("/render", json={**FRAME, "width": 0}).status_code == 503, "the body is not read"
        have = client.post("/render", json=FRAME, headers={"If-None-Match": "*"})
        assert have.status_code == 304, "a cached frame needs no place"
        for path in ("/live", "/ready", "/scenes/balls"):
            assert client.get(path).status_code == 200
        poses.go_on.set()
        assert [future.result(MAX_SECONDS).status_code for future in accepted] == [200] * 5
        assert client.post("/render", json=FRAME).status_code == 200


def test_addresses_count_only_from_a_trusted_proxy(scene: Path, poses: SlowPoses):
    settings: dict[str, Any] = {"concurrent_renders": 1, "queued_renders": 3, "proxies": "10.9.9.9"}
    with serving_slowly(scene, poses, **settings) as (client, server), ThreadPoolExecutor(2) as pool:
        queue = server.service.queue

        def ask(number: int) -> httpx.Response:
            return client.post("/render", json=FRAME, headers={"X-Forwarded-For": f"10.0.0.{number}"})

        accepted = [pool.submit(ask, number) for number in (1, 2)]
        eventually(lambda: (queue.running, queue.waiting) == (1, 1))
        refused = ask(3)
        check_problem(refused, 503)
        assert "2 places" in refused.json()["detail"], "all of them are one client"
        poses.go_on.set()
        assert [future.result(MAX_SECONDS).status_code for future in accepted] == [200] * 2


def test_with_keys_shares_are_by_key(scene: Path, poses: SlowPoses, tmp_path: Path):
    keys = ["first-0123456789", "second-0123456789"]
    (tmp_path / "keys").write_text("".join(f"read {key}\n" for key in keys))
    settings: dict[str, Any] = {"concurrent_renders": 1, "queued_renders": 3, "api_keys_file": tmp_path / "keys"}
    with serving_slowly(scene, poses, **settings) as (client, server), ThreadPoolExecutor(4) as pool:
        queue = server.service.queue

        def ask(key: str) -> httpx.Response:
            return client.post("/render", json=FRAME, headers={"X-API-Key": key})

        accepted = [pool.submit(ask, keys[0]) for _ in range(2)]
        eventually(lambda: (queue.running, queue.waiting) == (1, 1))
        check_problem(ask(keys[0]), 503)
        accepted.append(pool.submit(ask, keys[1]))
        eventually(lambda: (queue.running, queue.waiting) == (1, 2))
        check_problem(client.post("/render", json=FRAME), 401)
        poses.go_on.set()
        assert [future.result(MAX_SECONDS).status_code for future in accepted] == [200] * 3


def test_a_frame_that_takes_too_long_is_answered_in_time(scene: Path, poses: SlowPoses):
    with serving_slowly(scene, poses, render_seconds=0.3, concurrent_renders=1) as (client, server):
        started = time.monotonic()
        response = client.post("/render", json=FRAME)
        assert time.monotonic() - started >= 0.3
        check_problem(response, 504)
        assert server.service.queue.running == 1, "the place is taken until the thread is free"
        waiting = client.post("/render", json=FRAME)
        assert waiting.status_code == 504, "waiting counts"
        poses.slow = False
        poses.go_on.set()
        eventually(lambda: server.service.queue.running == 0)
        eventually(lambda: client.post("/render", json=FRAME).status_code == 200)


def leave(client: httpx.Client, body: dict[str, Any], path: str = "/render") -> socket.socket:
    content = json.dumps(body)
    head = f"POST {path} HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: {len(content)}"
    return connect(client, f"{head}\r\n\r\n{content}".encode())


@pytest.mark.parametrize("path", ["/render", "/render/batch"])
@pytest.mark.parametrize("part", [0.1, 0.5, 0.9])
def test_work_for_a_client_that_is_gone_ends(scene: Path, poses: SlowPoses, path: str, part: float):
    samples = 40
    body: dict[str, Any] = {**FRAME, "shutter": {"open": -0.1, "close": 0.1, "samples": samples}}
    with serving_slowly(scene, poses) as (client, server):
        poses.last = part * samples
        poses.go_on.set()
        connection = leave(client, {"frames": [body, {**body, "t": 0.6}]} if path.endswith("batch") else body, path)
        eventually(lambda: poses.begun >= poses.last)
        connection.close()
        queue = server.service.queue
        eventually(lambda: queue.running == queue.waiting == 0)
        assert poses.begun < samples


def test_a_client_that_leaves_the_queue_is_dropped(scene: Path, poses: SlowPoses):
    with serving_slowly(scene, poses, concurrent_renders=1) as (client, server), ThreadPoolExecutor(1) as pool:
        queue = server.service.queue
        first = pool.submit(client.post, "/render", json=FRAME)
        eventually(lambda: queue.running == 1)
        connection = leave(client, FRAME)
        eventually(lambda: queue.waiting == 1)
        connection.close()
        eventually(lambda: queue.waiting == 0)
        poses.go_on.set()
        assert first.result(MAX_SECONDS).status_code == 200
        assert poses.begun == 1


def test_a_stopping_service_finishes_accepted_requests(scene: Path, poses: SlowPoses):
    with (
        serving_slowly(scene, poses) as (client, server),
        httpx.Client(base_url=client.base_url) as other,
        ThreadPoolExecutor(8) as pool,
    ):
        frames = [pool.submit(client.post, "/render", json=FRAME) for _ in range(8)]
        queue = server.service.queue
        eventually(lambda: queue.running + queue.waiting == 8)
        server.handle_exit(signal.SIGTERM, None)
        assert other.get("/ready").status_code == 503
        assert other.get("/live").status_code == 200
        refused = other.post("/render", json=FRAME)
        assert refused.status_code == 503
        assert refused.headers["Retry-After"]
        poses.go_on.set()
        assert [frame.result(MAX_SECONDS).status_code for frame in frames] == [200] * 8
        eventually(lambda: not server.started or not _listens(client))


def _listens(client: httpx.Client) -> bool:
    try:
        connect(client).close()
    except OSError:
        return False
    return True


def test_a_cancelled_request_keeps_poses_of_others(scene: Path):
    cache, session = PoseCache(1 << 20), DeformationSession(scene)
    cancelled = RenderJob()
    cancelled.cancel()
    assert cache.get(session, 0.5, RenderJob()) is cache.get(session, 0.5, RenderJob())
    assert (cache.use.hits, cache.use.misses, cache.use.poses) == (1, 1, 1)
    with pytest.raises(Exception, match="cancelled"):
        cache.get(session, 0.5, cancelled)
