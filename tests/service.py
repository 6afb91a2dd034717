"""The service on a port of this machine, in a thread."""

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import uvicorn

from msdgs_serve.api.app import create_app
from msdgs_serve.api.cli import bind
from msdgs_serve.api.settings import Settings
from msdgs_serve.renderer import Renderer
from msdgs_serve.store import SceneStore


@contextlib.contextmanager
def serving(*scenes: Path, renderer: Renderer | None = None, **settings: Any) -> Iterator[httpx.Client]:
    """A client of a service over these scenes, which ends on leaving."""
    app = create_app(SceneStore(scenes), renderer or Renderer(), Settings(**settings))
    listener = bind("127.0.0.1", 0)
    server = uvicorn.Server(uvicorn.Config(app, log_level="error", timeout_graceful_shutdown=5))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]}, daemon=True)
    thread.start()
    deadline = time.monotonic() + 10
    while not server.started:
        assert thread.is_alive()
        assert time.monotonic() < deadline
        time.sleep(0.01)
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{listener.getsockname()[1]}", timeout=60) as client:
            yield client
    finally:
        server.should_exit = True
        thread.join(10)
        listener.close()
    assert not thread.is_alive()
