"""Clients that send or read too slowly are disconnected, and don't delay others."""

import contextlib
import socket
import time
from collections.abc import Iterator

import httpx
import pytest

from msdgs_serve.api.server import Server
from tests.support.scene_files import write_scene
from tests.support.service import serving

pytestmark = pytest.mark.slow

SECONDS = 1.0
SOCKETS = 50
MAX_SECONDS = 60.0  # whatever else the machine does; a service that never closes takes longer
FRAME = {"camera": {"type": "orbit", "azimuth": 0, "elevation": 0}, "t": 0.5, "width": 16, "height": 16}
HEAD = b"POST /render HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\nContent-Length: 1000\r\n\r\n"


@pytest.fixture(scope="module")
def server() -> list[Server]:
    return []


@pytest.fixture(scope="module")
def client(tmp_path_factory: pytest.TempPathFactory, server: list[Server]) -> Iterator[httpx.Client]:
    path = write_scene(tmp_path_factory.mktemp("scenes") / "balls.onnx")
    with serving(path, server=server, header_seconds=SECONDS, body_seconds=SECONDS, read_seconds=SECONDS) as client:
        yield client


def connect(client: httpx.Client) -> socket.socket:
    assert client.base_url.port
    return socket.create_connection((client.base_url.host, client.base_url.port), timeout=MAX_SECONDS)


def begun(client: httpx.Client, first: bytes) -> socket.socket:
    """A connection on which that much was sent."""
    connection = connect(client)
    connection.sendall(first)
    return connection


def takes(connection: socket.socket, drip: bytes) -> bool:
    """Whether more can be sent. If not it is closed, and its answer is lost: it came before what was sent since."""
    try:
        connection.sendall(drip)
    except OSError:
        return False
    return True


def rest_of(connection: socket.socket) -> bytes:
    """What comes until the other side closes."""
    received = b""
    try:
        while part := connection.recv(65536):
            received += part
    except ConnectionResetError:
        pass
    return received


@pytest.mark.parametrize(
    ("first", "drip", "status"),
    [(b"", b"", 408), (b"GET /live HTTP/1.1\r\n", b"X", 408), (HEAD, b"x", 408)],
    ids=["nothing", "headers", "body"],
)
def test_slow_senders_are_closed_and_others_are_served(client: httpx.Client, first: bytes, drip: bytes, status: int):
    assert client.post("/render", json=FRAME).status_code == 200, "kernels are compiled before seconds count"
    with contextlib.ExitStack() as sockets:
        silent, dripping = (
            [sockets.enter_context(begun(client, first)) for _ in range(SOCKETS // 2)] for _ in range(2)
        )
        deadline = time.monotonic() + MAX_SECONDS
        while drip and (dripping := [connection for connection in dripping if takes(connection, drip)]):
            assert client.post("/render", json=FRAME).status_code == 200
            assert time.monotonic() < deadline, "a drip makes it wait for ever"
            time.sleep(SECONDS / 10)
        for connection in silent:
            answer = rest_of(connection)
            assert answer.startswith(b"HTTP/1.1 %d " % status), answer[:100]
            assert b"application/problem+json" in answer


def test_a_drip_after_an_answer_is_closed_too(client: httpx.Client):
    connection = connect(client)
    connection.sendall(b"GET /live HTTP/1.1\r\nHost: x\r\n\r\n")
    assert connection.recv(65536).startswith(b"HTTP/1.1 200")
    connection.sendall(b"GET /li")
    assert b" 408 " in rest_of(connection)
    connection.close()


def test_who_offers_another_protocol_is_answered_in_this_one(client: httpx.Client):
    offer = {"Connection": "Upgrade, HTTP2-Settings", "Upgrade": "h2c", "HTTP2-Settings": "AAMAAABkAAQCAAAAAAIAAAAA"}
    assert client.post("/render", json=FRAME, headers=offer).status_code == 200


def test_a_reader_that_stands_still_is_closed(client: httpx.Client, server: list[Server]):
    before = len(server[0].server_state.connections)
    connection = connect(client)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    link = "/render?format=npy&width=1500&height=1000"  # 30 MB, more than any socket holds
    connection.sendall(f"GET {link} HTTP/1.1\r\nHost: x\r\n\r\n".encode())
    assert connection.recv(100).startswith(b"HTTP/1.1 200")
    deadline = time.monotonic() + MAX_SECONDS
    while len(server[0].server_state.connections) > before:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    connection.close()


def test_a_reader_that_is_only_slow_gets_all(client: httpx.Client):
    connection = connect(client)
    connection.sendall(b"GET /render?format=npy&width=300&height=200 HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
    received = 0
    while part := connection.recv(100_000):
        received += len(part)
        time.sleep(SECONDS / 10)
    assert received > 300 * 200 * 5 * 4
    connection.close()


@pytest.mark.parametrize(
    "sent",
    [b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03\r\n\r\n", b"GET / HTTP/9\r\n\r\n", b"GET /" + b"x" * 100_000],
    ids=["TLS", "version", "long"],
)
def test_what_is_no_http_is_a_problem_as_well(client: httpx.Client, sent: bytes):
    connection = connect(client)
    connection.sendall(sent)
    answer = rest_of(connection)
    connection.close()
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 400 Bad Request")
    response = httpx.Response(400, headers={"content-type": "application/problem+json"}, content=body)
    assert response.json()["status"] == 400
