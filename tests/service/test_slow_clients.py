"""Clients that send or read too slowly are disconnected, and don't delay others."""

import contextlib
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from msdgs_serve.api.cli import bind
from msdgs_serve.api.protocol import READ_BYTES
from msdgs_serve.api.server import Server
from tests.support.service import FRAME, MAX_SECONDS, connect, eventually, rest_of, serving

pytestmark = pytest.mark.slow

SECONDS = 1.0
SOCKETS = 50
HEAD = b"POST /render HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 1000\r\n\r\n"


@pytest.fixture(scope="module")
def server() -> list[Server]:
    return []


@pytest.fixture(scope="module")
def client(scene: Path, server: list[Server]) -> Iterator[httpx.Client]:
    with serving(scene, server=server, header_seconds=SECONDS, body_seconds=SECONDS, read_seconds=SECONDS) as client:
        yield client


def takes(connection: socket.socket, drip: bytes) -> bool:
    """Return whether more can be sent. If not, the service has closed the connection, and its response is lost."""
    try:
        connection.sendall(drip)
    except OSError:
        return False
    return True


@pytest.mark.parametrize(
    ("first", "drip"), [(b"", b""), (b"GET /live HTTP/1.1\r\n", b"X"), (HEAD, b"x")], ids=["nothing", "headers", "body"]
)
def test_slow_senders_are_closed_and_others_are_served(client: httpx.Client, first: bytes, drip: bytes):
    assert client.post("/render", json=FRAME).status_code == 200, "kernels are compiled before the time limit applies"
    with contextlib.ExitStack() as sockets:
        silent, dripping = (
            [sockets.enter_context(connect(client, first)) for _ in range(SOCKETS // 2)] for _ in range(2)
        )
        deadline = time.monotonic() + MAX_SECONDS
        while drip and (dripping := [connection for connection in dripping if takes(connection, drip)]):
            assert client.post("/render", json=FRAME).status_code == 200
            assert time.monotonic() < deadline, "single bytes keep it waiting forever"
            time.sleep(SECONDS / 10)
        for connection in silent:
            answer = rest_of(connection)
            assert answer.startswith(b"HTTP/1.1 408 "), answer[:100]
            assert b"application/problem+json" in answer


def test_a_drip_after_an_answer_is_closed_too(client: httpx.Client):
    connection = connect(client, b"GET /live HTTP/1.1\r\nHost: x\r\n\r\n")
    assert connection.recv(65536).startswith(b"HTTP/1.1 200")
    connection.sendall(b"GET /li")
    assert b" 408 " in rest_of(connection)
    connection.close()


def test_a_drip_of_a_body_that_was_answered_is_closed_too(client: httpx.Client):
    connection = connect(client, HEAD.replace(b"/render", b"/scenes?name=x").replace(b"1000", b"1000000"))
    assert connection.recv(65536).startswith(b"HTTP/1.1 403"), "there are no uploads"
    deadline = time.monotonic() + MAX_SECONDS
    while takes(connection, b"x"):
        assert time.monotonic() < deadline, "single bytes keep it open forever"
        time.sleep(SECONDS / 10)
    connection.close()


def test_an_offer_of_http2_is_ignored(client: httpx.Client):
    offer = {"Connection": "Upgrade, HTTP2-Settings", "Upgrade": "h2c", "HTTP2-Settings": "AAMAAABkAAQCAAAAAAIAAAAA"}
    assert client.post("/render", json=FRAME, headers=offer).status_code == 200


def test_a_reader_that_stands_still_is_closed(client: httpx.Client, server: list[Server]):
    before = len(server[0].server_state.connections)
    connection = connect(client)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    link = "/render?format=npy&width=1500&height=1000"  # 30 MB, more than socket buffers hold
    connection.sendall(f"GET {link} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
    assert connection.recv(100).startswith(b"HTTP/1.1 200")
    eventually(lambda: len(server[0].server_state.connections) <= before)
    connection.close()


def test_a_slow_reader_is_seen_to_read():
    """A large buffer empties in steps that are farther apart than the time limit."""
    with bind("127.0.0.1", 0) as listener:
        assert listener.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF) <= 4 * READ_BYTES


@pytest.mark.parametrize(
    "sent",
    [b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n", b"GET / HTTP/9\r\n\r\n", b"GET /" + b"x" * 100_000],
    ids=["TLS", "version", "long"],
)
def test_invalid_http_gets_a_problem(client: httpx.Client, sent: bytes):
    connection = connect(client, sent)
    answer = rest_of(connection)
    connection.close()
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 400 Bad Request")
    response = httpx.Response(400, headers={"content-type": "application/problem+json"}, content=body)
    assert response.json()["status"] == 400
