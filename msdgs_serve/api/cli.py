"""The command `msdgs-serve`: reads settings from flags and environment and runs the server."""

import gc
import json
import logging
import os
import socket
import sys
import time
from collections.abc import Sequence

from pydantic import ValidationError

from msdgs_serve.api.app import create_app
from msdgs_serve.api.arguments import PROGRAM, read_settings
from msdgs_serve.api.observe import JsonLines
from msdgs_serve.api.openapi import render_examples
from msdgs_serve.api.server import Server
from msdgs_serve.api.settings import Settings
from msdgs_serve.process import EXIT_INVALID
from msdgs_serve.rasterizer.precompile import compile_kernels
from msdgs_serve.renderer import Renderer
from msdgs_serve.scene import MsdgsError
from msdgs_serve.store import SceneStore
from msdgs_serve.threads import THREADS_VARIABLE

SEND_BUFFER = 1 << 17
"""Bytes of a response in the system's buffer. A larger one empties in steps that take a slow client longer than the
time limit on reading, which then closes its connection although it reads."""
LOOPBACK = {"0.0.0.0": "127.0.0.1", "::": "::1"}
"""By an address that stands for all, the one on which this machine reaches itself."""
SWITCH_SECONDS = 0.001
"""Switch interval of Python's interpreter. Under 4x overload the slowest accepted frames wait 0.7 times as long as with
Python's default of 5 ms, and /live a quarter as long."""


class UsageError(Exception):
    """An error in how the program was started."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve until Ctrl-C. Return the exit status: 2 for invalid settings, scenes or port."""
    try:
        settings = _settings(sys.argv[1:] if arguments is None else arguments)
        _configure_logging(settings)
        if settings.threads is not None:
            os.environ[THREADS_VARIABLE] = str(settings.threads)
        if settings.compile:
            return _compile()
        _serve(settings)
    except KeyboardInterrupt:
        pass
    except (UsageError, MsdgsError) as error:
        print(f"{PROGRAM}: {error}", file=sys.stderr)
        return EXIT_INVALID
    print("Stopped.", flush=True)
    return 0


def _settings(arguments: Sequence[str]) -> Settings:
    try:
        settings = read_settings(arguments)
    except ValidationError as error:
        errors = [item for item in error.errors() if item["type"] != "default_factory_not_called"]  # follows another
        wrong = [f"{_setting(str(item['loc'][0]))}: {item['msg']}" for item in errors]
        raise UsageError("; ".join(wrong)) from None
    if not (settings.scenes or settings.compile):
        raise UsageError(f"no scene given; `{PROGRAM} scene.onnx` serves one, see `{PROGRAM} --help`")
    return settings


def _setting(name: str) -> str:
    """A setting's option, and its environment variable if that is set."""
    option, variable = f"--{name.replace('_', '-')}", f"MSDGS_{name.upper()}"
    return f"{option} or {variable}" if variable in os.environ else option


def _configure_logging(settings: Settings) -> None:
    handler = logging.StreamHandler()
    handler.setFormatter(
        JsonLines() if settings.log_format == "json" else logging.Formatter("%(levelname)s %(name)s: %(message)s")
    )
    logging.basicConfig(level=settings.log_level.upper(), handlers=[handler], force=True)
    logging.getLogger("uvicorn").setLevel(logging.WARNING)


def _compile() -> int:
    print("Compiling kernels, which takes up to a minute …", flush=True)
    started = time.perf_counter()
    folder = compile_kernels()
    print(f"Kernels are ready after {time.perf_counter() - started:.1f} s, in {folder}", flush=True)
    return 0


def _serve(settings: Settings) -> None:
    sys.setswitchinterval(SWITCH_SECONDS)
    store, renderer = settings.open_store(), Renderer(settings.cache_megabytes << 20, settings.sequence_megabytes << 20)
    app = create_app(store, renderer, settings)
    with bind(settings.host, settings.port) as listener:
        print("Loading scenes; the first start compiles kernels, which takes up to a minute …", flush=True)
        server = _AnnouncedServer(app, settings, store, listener)
        try:
            server.run(sockets=[listener])
        finally:
            gc.unfreeze()  # otherwise OpenImageIO's bindings report leaked objects at exit
    if server.service.failure is not None:
        raise server.service.failure


class _AnnouncedServer(Server):
    """A server that prints its address when it is ready."""

    def __init__(self, app: object, settings: Settings, store: SceneStore, listener: socket.socket) -> None:
        super().__init__(app, settings)  # pyright: ignore[reportArgumentType]
        self._store = store
        self._address: tuple[str, int] = listener.getsockname()[:2]

    def on_ready(self) -> None:
        # objects of the startup are permanent: scanning them in each garbage collection makes the slowest frames under
        # 4x overload take 1.3 times as long
        gc.collect()
        gc.freeze()
        names = self._store.names()
        print(f"{len(names)} scene(s) after {self.service.start_seconds:.1f} s: {', '.join(names[:20])}", flush=True)
        if not names:
            print(f"{PROGRAM}: no .onnx files found; new files are served when they are added", file=sys.stderr)
        listening, url = addresses(*self._address)
        everywhere = "" if listening == url else ", all addresses of this machine or container"
        print(f"Listening on {listening}{everywhere} (Ctrl-C stops). API documentation: {url}/docs")
        for example in list(render_examples(self._store).values())[:1]:
            body = json.dumps(example["value"]).replace("'", "'\\''")
            print(f"Try:\n  curl {url}/render -H 'content-type: application/json' -o frame.png \\\n    -d '{body}'")
        sys.stdout.flush()


def addresses(host: str, port: int) -> tuple[str, str]:
    """Return the URL of the address that is listened on, and the URL by which this machine reaches it."""
    listening, local = (f"[{each}]" if ":" in each else each for each in (host, LOOPBACK.get(host, host)))
    return f"http://{listening}:{port}", f"http://{local}:{port}"


def bind(host: str, port: int) -> socket.socket:
    """Return a bound socket that doesn't listen yet, so that a port in use is reported before scenes are loaded.

    Its protocol is set explicitly: otherwise asyncio doesn't disable Nagle's algorithm, which costs 40 ms per request.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            listener.bind(address)
        except BaseException:
            listener.close()
            raise
    except OSError as error:
        raise UsageError(f"can't listen on {host} port {port}: {error.strerror}") from None
    return listener
