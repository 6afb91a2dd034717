"""The service on a port of this machine, in a thread; with MSDGS_TEST_SERVICE=ray on Ray Serve."""

import contextlib
import os
import socket
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest

from msdgs_serve.api.app import create_app
from msdgs_serve.api.cli import bind
from msdgs_serve.api.errors import MAX_BODY_BYTES
from msdgs_serve.api.server import Server
from msdgs_serve.api.service import Phase
from msdgs_serve.api.settings import Settings
from msdgs_serve.renderer import Renderer
from tests.support.processes import wait_for
from tests.support.service_on_ray import serving_on_ray

ORBIT = {"type": "orbit", "azimuth": 0, "elevation": 0}
FRAME = {"camera": ORBIT, "t": 0.5, "width": 16, "height": 16}
MAX_SECONDS = 300.0
"""Maximum seconds that a test waits, also on a busy machine that compiles kernels first."""

eventually = partial(wait_for, seconds=MAX_SECONDS)
WATCH_SECONDS = 0.05
SERVICE_VARIABLE = "MSDGS_TEST_SERVICE"
ON_RAY = os.environ.get(SERVICE_VARIABLE) == "ray"
in_this_process = pytest.mark.skipif(ON_RAY, reason="reaches into the process of the service: not on Ray Serve")
own_connection = pytest.mark.skipif(ON_RAY, reason="slow connections end at the proxy of Ray Serve")


@contextlib.contextmanager
def serving(
    *scenes: Path, renderer: Renderer | None = None, server: list[Server] | None = None, **settings: Any
) -> Iterator[httpx.Client]:
    """A client of a service with these scenes, which stops at the end of the block. The server is added to `server`."""
    chosen = Settings(
        scenes=list(scenes), **{"watch_seconds": WATCH_SECONDS, "port": 0, "render_seconds": MAX_SECONDS, **settings}
    )
    if ON_RAY:
        if renderer is not None or server is not None or chosen.port:
            pytest.skip("reaches into the process of the service, or needs its port: not on Ray Serve")
        with serving_on_ray(chosen) as client:
            yield client
        return
    app = create_app(chosen.open_store(), renderer or Renderer(), chosen)
    listener = bind("127.0.0.1", chosen.port)
    running = Server(app, chosen)
    if server is not None:
        server.append(running)
    thread = threading.Thread(target=running.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()

    def started() -> bool:
        assert thread.is_alive(), running.service.failure
        return running.started and running.service.phase is not Phase.STARTING

    eventually(started)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{listener.getsockname()[1]}", timeout=MAX_SECONDS) as client:
            yield client
    finally:
        running.should_exit = True
        thread.join(MAX_SECONDS)
        listener.close()
    assert not thread.is_alive()


def connect(client: httpx.Client, first: bytes = b"") -> socket.socket:
    """Return a plain connection to a client's service, after `first` is sent."""
    assert client.base_url.port
    connection = socket.create_connection((client.base_url.host, client.base_url.port), timeout=MAX_SECONDS)
    connection.sendall(first)
    return connection


def rest_of(connection: socket.socket) -> bytes:
    """Return what the service sends until it closes the connection."""
    received = bytearray()
    with contextlib.suppress(ConnectionResetError):
        while part := connection.recv(1 << 20):
            received += part
    return bytes(received)


def check_problem(response: httpx.Response, status: int | None = None, field: str | None = None) -> None:
    """Check that a response has the shape of all errors and, if given, the status and the first field."""
    assert status in (None, response.status_code), response.text[:500]
    assert response.headers["content-type"] == "application/problem+json"
    assert len(response.content) <= MAX_BODY_BYTES
    problem = response.json()
    assert set(problem) == {"type", "title", "status", "detail", "errors"}
    assert problem["status"] == response.status_code
    assert problem["title"]
    assert problem["detail"]
    if field is not None:
        assert problem["errors"][0]["field"] == field, response.text[:500]
