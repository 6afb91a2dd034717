"""nginx with the settings of docker/nginx in front of replicas that answer as a test tells them."""

import contextlib
import json
import os
import pwd
import re
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx

from tests.support.processes import ROOT, free_port, wait_for

SETTINGS = ROOT / "docker" / "nginx"
READ_SECONDS = 1
"""How long nginx waits for a frame in tests of that."""


class Server(ThreadingHTTPServer):
    """A server that calls `answer` for each request."""

    daemon_threads = True
    block_on_close = False
    answer: Callable[["Handler"], None]


class Handler(BaseHTTPRequestHandler):
    """Reads a request and lets the server answer."""

    protocol_version = "HTTP/1.1"
    wbufsize = 1 << 16  # head and body are sent together, or the second waits 40 ms for the first to be acknowledged
    server: Server  # pyright: ignore[reportIncompatibleVariableOverride]

    def do_GET(self) -> None:
        """Answer a request of any method."""
        self.rfile.read(int(self.headers.get("content-length") or 0))
        self.server.answer(self)

    do_POST = do_DELETE = do_HEAD = do_GET

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""

    def send(self, status: int, body: bytes, pause: float) -> None:
        """Send a response with JSON, with a pause after its head."""
        self.send_response(status)
        self.send_header("Content-Type", "application/problem+json")
        self.send_header("Content-Length", str(len(body)))
        if status == 200:
            self.send_header("Cache-Control", "public, max-age=3600")
        if status == 503:
            self.send_header("Retry-After", "7")
        self.end_headers()
        if pause:
            self.wfile.flush()
            time.sleep(pause)
        self.wfile.write(b"" if self.command == "HEAD" else body)


@dataclass
class Replica:
    """A replica that answers with a status, closes the connection (0) or hangs (None); it notes the requests."""

    status: int | None = 200
    pause: float = 0.0
    asked: list[str] = field(default_factory=list)
    released: threading.Event = field(default_factory=threading.Event)

    def answer(self, request: Handler) -> None:
        """Answer as `status` says."""
        self.asked.append(f"{request.command} {request.path}")
        if self.status:
            request.send(
                self.status, json.dumps({"status": self.status, "detail": "from a replica"}).encode(), self.pause
            )
        else:
            request.close_connection = True
            if self.status is None:
                self.released.wait()


@dataclass
class Proxy:
    """A running nginx: a client of it, and its replicas and log."""

    client: httpx.Client
    replicas: list[Replica]
    folder: Path

    def log(self, request_id: str) -> dict[str, Any]:
        """Return the entry of a request, which is written after its response."""
        found = list[dict[str, Any]]()

        def is_written() -> bool:
            entries = map(json.loads, (self.folder / "access.log").read_text().splitlines())
            found.extend(entry for entry in entries if entry["id"] == request_id)
            return bool(found)

        wait_for(is_written)
        return found[0]


@contextlib.contextmanager
def proxying(folder: Path, *statuses: int | None) -> Iterator[Proxy]:
    """Run nginx in front of replicas that answer with these statuses."""
    replicas = [Replica(status) for status in statuses]
    with contextlib.ExitStack() as stack:
        servers = list[Server]()
        for replica in replicas:
            server = stack.enter_context(Server(("127.0.0.1", 0), Handler))
            server.answer = replica.answer
            threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
            stack.callback(server.shutdown)
            stack.callback(replica.released.set)
            servers.append(server)
        client = stack.enter_context(running_nginx(folder, [server.server_port for server in servers]))
        yield Proxy(client, replicas, folder)


@contextlib.contextmanager
def running_nginx(folder: Path, ports: list[int], read_seconds: int = READ_SECONDS) -> Iterator[httpx.Client]:
    """Run nginx with the settings of docker/nginx, in front of these ports of this machine."""
    port = free_port()
    changes = {
        r" /tmp/": f" {folder}/",
        r" /dev/stdout": f" {folder}/access.log",
        r"worker_processes auto": "worker_processes 1",
        r"listen 8080": f"listen 127.0.0.1:{port}",
        r"(?m)^    proxy_read_timeout \d+s": f"    proxy_read_timeout {read_seconds}s",
    }
    settings = (SETTINGS / "nginx.conf").read_text()
    for pattern, value in changes.items():
        settings, count = re.subn(pattern, value, settings)
        assert count, pattern
    (folder / "nginx.conf").write_text(settings)
    for name in re.findall(r"include (\S+);", settings):
        (line,) = re.findall(r"^server .*", (SETTINGS / name).read_text(), re.MULTILINE)
        servers = [line.replace("render:8000 resolve", f"127.0.0.1:{each}") for each in ports]
        (folder / name).write_text("\n".join(servers))
    user = pwd.getpwuid(os.getuid()).pw_name
    command = ["nginx", "-p", folder, "-c", "nginx.conf", "-g", f"daemon off; user {user};"]
    with (folder / "errors.log").open("w") as errors, subprocess.Popen(command, stderr=errors) as process:
        try:
            with httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60) as client:
                wait_for(lambda: process.poll() is not None or is_listening(client))
                assert process.poll() is None, (folder / "errors.log").read_text()
                yield client
        finally:
            process.terminate()


def is_listening(client: httpx.Client) -> bool:
    """Whether nginx answers; no replica is asked."""
    with contextlib.suppress(httpx.TransportError):
        return client.get("/metrics").status_code == 404
    return False
