"""Responses that clients haven't read yet: their memory is bounded, and a stopping service sends them to the end."""

import contextlib
import signal
import socket
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import httpx
import pytest

import msdgs_serve.api.server
from msdgs_serve.api.errors import RequestRejected
from msdgs_serve.api.server import Server
from msdgs_serve.api.work import WorkQueue
from tests.support.service import FRAME, MAX_SECONDS, check_problem, connect, eventually, rest_of, serving

BYTES = 1500 * 1000 * 5 * 4  # more than socket buffers hold
LARGE = b"GET /render?format=npy&width=1500&height=1000 HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"


@contextlib.contextmanager
def unread_response(client: httpx.Client, server: Server) -> Iterator[socket.socket]:
    """A connection with a large response, complete in the service, of which the client hasn't read anything."""
    with connect(client) as connection:
        connection.sendall(LARGE)
        eventually(lambda: server._unread().total() > 1 << 20 and not server.server_state.tasks)
        yield connection


def test_a_client_has_as_many_unread_bytes_as_it_leaves():
    queue = WorkQueue(workers=2, waiting=6, seconds=20, max_unread=100)
    with ExitStack() as calls:
        for bytes_of_one, bytes_of_two, one, two in ((49, 0, True, True), (50, 0, False, True), (40, 60, False, False)):
            unread = Counter(one=bytes_of_one, two=bytes_of_two)
            queue.unread = lambda unread=unread: unread
            for client, is_admitted in (("one", one), ("two", two)):
                with contextlib.nullcontext() if is_admitted else pytest.raises(RequestRejected, match="read"):
                    calls.enter_context(queue.admitted(client))
    queue.shut_down()


@pytest.mark.slow
def test_new_frames_are_refused_until_responses_are_read(scene: Path):
    servers: list[Server] = []
    with serving(scene, server=servers, read_seconds=MAX_SECONDS, unread_megabytes=1) as client:
        with unread_response(client, servers[0]) as connection:
            refused = client.post("/render", json=FRAME)
            check_problem(refused, 503)
            assert refused.headers["Retry-After"] == "1"
            assert client.get("/live").status_code == 200
            assert len(rest_of(connection)) > BYTES
        eventually(lambda: client.post("/render", json=FRAME).status_code == 200)


@pytest.mark.slow
def test_a_stopping_service_sends_complete_responses_to_the_end(scene: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(msdgs_serve.api.server, "CLOSING_SECONDS", 0)
    servers: list[Server] = []
    with (
        serving(scene, server=servers, read_seconds=MAX_SECONDS, drain_seconds=MAX_SECONDS) as client,
        unread_response(client, servers[0]) as connection,
    ):
        servers[0].handle_exit(signal.SIGTERM, None)
        time.sleep(0.5)  # several ticks, at each of which the service could end
        assert client.get("/live").status_code == 200
        assert len(rest_of(connection)) > BYTES
