"""`msdgs-serve`: settings from flags and environment, scenes loaded, kernels warmed, then the server."""

import json
import logging
import os
import socket
import sys
import time
from collections.abc import Sequence

import uvicorn
from pydantic import ValidationError

from msdgs_serve.api.app import create_app
from msdgs_serve.api.cameras import resolve_camera
from msdgs_serve.api.openapi import render_examples
from msdgs_serve.api.schemas import RenderRequest
from msdgs_serve.api.settings import PROGRAM, Settings
from msdgs_serve.imaging import encode
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene import InvalidInput, SceneFileInvalid
from msdgs_serve.store import SceneStore
from msdgs_serve.threads import THREADS_VARIABLE

USAGE_ERROR = 2
SHUTDOWN_SECONDS = 30  # for requests in work when Ctrl-C comes


class UsageError(Exception):
    """What the person who started the program can put right."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until Ctrl-C. Returns the exit status: 2 where settings, scenes or the port are wrong."""
    try:
        settings = _settings(sys.argv[1:] if arguments is None else arguments)
        logging.basicConfig(level=settings.log_level.upper(), format="%(levelname)s %(name)s: %(message)s")
        if settings.threads is not None:
            os.environ[THREADS_VARIABLE] = str(settings.threads)
        _serve(settings)
    except KeyboardInterrupt:
        pass
    except (UsageError, InvalidInput, SceneFileInvalid) as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return USAGE_ERROR
    print("Stopped.", flush=True)
    return 0


def _settings(arguments: Sequence[str]) -> Settings:
    try:
        settings = Settings(_cli_parse_args=list(arguments))  # pyright: ignore[reportCallIssue]
    except ValidationError as error:
        wrong = [f"--{item['loc'][0]}: {item['msg']}".replace("_", "-") for item in error.errors()]
        raise UsageError("; ".join(wrong)) from None
    if not settings.scenes:
        raise UsageError(f"which scene? `{PROGRAM} scene.onnx` serves one; `{PROGRAM} --help` tells more")
    return settings


def _serve(settings: Settings) -> None:
    store, renderer = SceneStore(settings.scenes), Renderer(settings.cached_poses)
    with bind(settings.host, settings.port) as listener:
        _load(settings, store, renderer)
        app = create_app(store, renderer, settings)
        config = uvicorn.Config(
            app, log_level=settings.log_level, timeout_graceful_shutdown=SHUTDOWN_SECONDS, server_header=False
        )
        _Server(config, store, listener).run(sockets=[listener])


class _Server(uvicorn.Server):
    """Says where it listens, once it does."""

    def __init__(self, config: uvicorn.Config, store: SceneStore, listener: socket.socket) -> None:
        super().__init__(config)
        self._store = store
        self._listener = listener

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        host, port = self._listener.getsockname()[:2]
        host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host) or str(host)
        url = f"http://[{host}]:{port}" if ":" in host else f"http://{host}:{port}"
        print(f"Listening on {url} (Ctrl-C stops). Every call is explained at {url}/docs")
        for example in list(render_examples(self._store).values())[:1]:
            body = json.dumps(example["value"]).replace("'", "'\\''")
            print(f"Try:\n  curl {url}/render -H 'content-type: application/json' -o frame.png \\\n    -d '{body}'")
        sys.stdout.flush()


def bind(host: str, port: int) -> socket.socket:
    """A socket that has its port but doesn't listen yet, so that a port in use is told before anything is loaded.

    It knows its protocol: only then asyncio sends without Nagle's delay, which would cost 40 ms a request.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(address)
        except BaseException:
            listener.close()
            raise
    except OSError as error:
        raise UsageError(f"can't listen on {host} port {port}: {error.strerror}") from None
    return listener


def _load(settings: Settings, store: SceneStore, renderer: Renderer) -> None:
    """Load the scenes given as files, and draw one small frame so that the kernels are compiled."""
    started = time.perf_counter()
    print("Loading; the very first start compiles, which takes up to a minute …", flush=True)
    files = [path.stem for path in settings.scenes if path.is_file()]
    for name in files:
        store.get(name)
    for name in files[:1] or _first_that_loads(store):
        session = store.get(name)
        metadata = session.scene.metadata
        camera = {"type": "orbit", "azimuth": 0, "elevation": 0}
        request = RenderRequest.model_validate({"camera": camera, "t": 0, "width": 32, "height": 32})
        encode(renderer.render(session, resolve_camera(request, metadata), metadata.time_range[0]), "png")
    names = store.names()
    print(f"{len(names)} scene(s) after {time.perf_counter() - started:.1f} s: {', '.join(names[:20])}", flush=True)
    if not names:
        print(f"{PROGRAM}: no .onnx file there yet; scenes are served as they come", file=sys.stderr)


def _first_that_loads(store: SceneStore) -> list[str]:
    for name in store.names():
        try:
            store.get(name)
        except SceneFileInvalid as error:
            print(f"{PROGRAM}: {error}", file=sys.stderr)
        else:
            return [name]
    return []
