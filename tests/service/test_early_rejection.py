"""Requests that are rejected before they are parsed, with the same answer as from the application."""

import logging
import socket
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from http.client import HTTPResponse
from pathlib import Path

import pytest

from msdgs_serve.api.early_rejection import EarlyRejection
from msdgs_serve.api.metrics import Metrics
from msdgs_serve.api.server import Server
from msdgs_serve.api.work import WorkQueue
from msdgs_serve.renderer import Renderer
from msdgs_serve.store import SceneStore
from tests.support.scene_files import write_scene
from tests.support.service import connect, in_this_process, serving

BODY = b'{"t": 0}'
HEAD = b"POST /render HTTP/1.1\r\nHost: here\r\nContent-Type: application/json\r\nContent-Length: 8\r\n"
CALL = HEAD + b"\r\n" + BODY
CHANGES = "date", "x-request-id", "retry-after"
REFUSED = 'msdgs_problems_total{kind="overloaded"}', 'msdgs_requests_total{method="POST",route="/render",status="503"}'


@contextmanager
def full(queue: WorkQueue, places: int) -> Iterator[None]:
    """Occupy places in the queue by calls that do nothing."""
    with ExitStack() as calls:
        for number in range(places):
            calls.enter_context(queue.admitted(str(number)))
        yield


@pytest.fixture
def queue() -> Iterator[WorkQueue]:
    queue = WorkQueue(workers=1, waiting=1, seconds=20)
    yield queue
    queue.shut_down()


@pytest.fixture
def early_rejection(queue: WorkQueue) -> EarlyRejection:
    renderer = Renderer()
    return EarlyRejection(queue, Metrics(SceneStore([]), renderer.cache, queue), max_body_bytes=8)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        HEAD,
        HEAD + b"\r\n",
        CALL[:-1],
        CALL + b"P",
        CALL + CALL,
        CALL.replace(b"Length: 8", b"Length: 9") + b" ",
        CALL.replace(b"here", b"he\x00re"),
        CALL.replace(b"POST", b"GET"),
        CALL.replace(b"/render", b"/render/batch"),
        CALL.replace(b"/render", b"/render?t=1"),
        CALL.replace(b"1.1", b"1.0"),
        CALL.replace(b"Length: 8", b"Length: eight"),
        CALL.replace(b"Length: 8", b"Length: +8"),
        HEAD + b"Content-Length: 8\r\n\r\n" + BODY,
        HEAD + b"If-None-Match: *\r\n\r\n" + BODY,
        HEAD + b"Expect: 100-continue\r\n\r\n" + BODY,
        HEAD + b"Transfer-Encoding: chunked\r\n\r\n" + BODY,
        HEAD + b"Connection: close\r\n\r\n" + BODY,
        HEAD + b"Upgrade: h2c\r\n\r\n" + BODY,
        HEAD + b"X-Forwarded-For: 1.2.3.4\r\n\r\n" + BODY,
        HEAD + b" folded\r\n\r\n" + BODY,
        HEAD + b"no colon\r\n\r\n" + BODY,
        HEAD.replace(b"Host: here\r\n", b"") + b"\r\n" + BODY,
        HEAD.replace(b"Host", b"Host ") + b"\r\n" + BODY,
    ],
)
def test_unusual_requests_are_left_to_the_application(early_rejection: EarlyRejection, queue: WorkQueue, data: bytes):
    with full(queue, 2):
        assert early_rejection.answer(data, None, ()) is None


def sent(connection: socket.socket, data: bytes) -> tuple[int, dict[str, str], bytes]:
    connection.sendall(data)
    response = HTTPResponse(connection)
    response.begin()
    return response.status, {name.lower(): value for name, value in response.getheaders()}, response.read()


@in_this_process
def test_the_answer_is_that_of_the_application(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    """Response, log line and counts are those of the application, and the connection stays usable."""
    write_scene(tmp_path / "ball.onnx")
    slow = HEAD + b"Accept-Charset: utf-8\r\n\r\n" + BODY  # an unknown header
    named = HEAD + b"X-Request-ID: mine\r\n\r\n" + BODY
    servers: list[Server] = []
    caplog.set_level(logging.INFO, "msdgs_serve.access")
    with serving(tmp_path / "ball.onnx", server=servers, concurrent_renders=1, queued_renders=1) as client:
        service = servers[0].service
        with connect(client) as connection:
            with full(service.queue, 2):
                answers = [sent(connection, data) for data in (CALL, slow, CALL)]
                assert sent(connection, named)[1]["x-request-id"] == "mine"
            for status, headers, body in answers:
                assert status == 503
                assert body == answers[0][2]
                assert headers.keys() == answers[0][1].keys()
                assert all(value == answers[0][1][name] for name, value in headers.items() if name not in CHANGES)
            assert len({headers["x-request-id"] for _, headers, _ in answers}) == 3
            assert sent(connection, CALL)[0] == 422, "there is a place, but the camera is missing"
        counted = client.get("/metrics").text.splitlines()
        assert [line.split()[-1] for name in REFUSED for line in counted if line.startswith(name)] == ["4.0", "4.0"]
    lines = [vars(record)["facts"] for record in caplog.records if vars(record)["facts"]["status"] == 503]
    facts = [{name: fact for name, fact in line.items() if name != "milliseconds"} for line in lines]
    assert facts == facts[:1] * 4
