"""The service on a port of this machine, in a thread."""

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx

from msdgs_serve.api.app import create_app
from msdgs_serve.api.cli import bind
from msdgs_serve.api.server import Server
from msdgs_serve.api.service import Phase
from msdgs_serve.api.settings import Settings
from msdgs_serve.renderer import Renderer
from msdgs_serve.store import SceneStore

WATCH_SECONDS = 0.05


@contextlib.contextmanager
def serving(
    *scenes: Path, renderer: Renderer | None = None, server: list[Server] | None = None, **settings: Any
) -> Iterator[httpx.Client]:
    """A client of a service over these scenes, which ends on leaving. The server is added to `server`."""
    chosen = Settings(scenes=list(scenes), **{"watch_seconds": WATCH_SECONDS, "port": 0, **settings})
    app = create_app(SceneStore(scenes), renderer or Renderer(), chosen)
    listener = bind("127.0.0.1", chosen.port)
    running = Server(app, chosen)
    if server is not None:
        server.append(running)
    thread = threading.Thread(target=running.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    deadline = time.monotonic() + 60
    while running.service.phase is Phase.STARTING or not running.started:
        assert thread.is_alive(), running.service.failure
        assert time.monotonic() < deadline
        time.sleep(0.01)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{listener.getsockname()[1]}", timeout=60) as client:
            yield client
    finally:
        running.should_exit = True
        thread.join(10)
        listener.close()
    assert not thread.is_alive()
