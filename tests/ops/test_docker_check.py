"""docker/check.py counts every request that isn't answered."""

import importlib.util
import socket
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import pytest

from tests.support.processes import ROOT


@pytest.fixture(scope="module")
def get() -> Callable[[str], Any]:
    spec = importlib.util.spec_from_file_location("composition", ROOT / "docker" / "composition.py")
    assert spec
    assert spec.loader
    composition = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(composition)
    return composition.get


@pytest.mark.parametrize(
    ("sent", "status", "body"),
    [
        (b"HTTP/1.1 200 OK\r\nContent-Length: 4\r\n\r\nbody", 200, b"body"),
        (b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 4\r\n\r\nbody", 503, b"body"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 9\r\n\r\nbody", 0, b""),
        (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n4\r\nbody\r\n", 0, b""),
        (b"HTTP/1.1 503 Service Unavailable\r\nContent-Length: 9\r\n\r\nbody", 0, b""),
        (b"nonsense\r\n", 0, b""),
        (b"", 0, b""),
    ],
)
def test_a_response_that_is_not_complete_has_no_status(
    get: Callable[[str], Any], sent: bytes, status: int, body: bytes
):
    with socket.create_server(("127.0.0.1", 0)) as server, ThreadPoolExecutor(1) as pool:

        def answer() -> None:
            connection, _ = server.accept()
            with connection:
                connection.recv(1 << 16)
                connection.sendall(sent)

        answered = pool.submit(answer)
        response = get(f"http://127.0.0.1:{server.getsockname()[1]}")
        answered.result()
    assert (response.status, response.body) == (status, body)
