"""The composition for docker/check.py: build, start, change, and ask it."""

import json
import os
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from email.message import Message
from http.client import HTTPException
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[1]
DOCKER = os.environ.get("DOCKER", "docker")
IMAGE = os.environ.get("MSDGS_IMAGE", "msdgs:check")
BASE_IMAGE = os.environ.get("BASE_IMAGE", "python:3.11-slim-bookworm")
PROXY_IMAGE = os.environ.get("PROXY_IMAGE", "nginx:1.28-alpine")
PROJECT = "msdgs-check"
LEFT_OUT_SECONDS = 11.0
"""How long the proxy may still leave out replicas that were starting; more than `fail_timeout` in replicas.conf."""
MAX_START_SECONDS = 120.0
"""Maximum seconds until a service is ready, also on a busy machine."""


class Response(NamedTuple):
    """The response to an HTTP request."""

    status: int
    headers: Message  # names in any case
    body: bytes


class Composition:
    """The composition, with the settings of compose.yaml."""

    def __init__(self, **settings: str) -> None:
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        images = {"MSDGS_IMAGE": IMAGE, "BASE_IMAGE": BASE_IMAGE, "PROXY_IMAGE": PROXY_IMAGE}
        self._environment = {**os.environ, **images, "PORT": f"127.0.0.1:{self.port}", **settings}

    def build(self) -> None:
        """Build the image of the service."""
        self._compose("build", "render", capture_output=False)

    def scale(self, replicas: int) -> None:
        """Start or remove replicas until there are so many, and wait until they are ready."""
        self._compose("up", "--detach", "--no-build", "--no-recreate", "--scale", f"render={replicas}")
        self.wait_until_ready()

    def wait_until_ready(self) -> None:
        """Wait until the proxy and all replicas are ready."""
        wait_for(lambda: get(f"{self.url}/ready"))
        for name in containers("render"):
            status = "python /opt/msdgs/ready.py && echo 200 || echo 503"
            wait_for(lambda name=name, status=status: Response(int(sh(name, status) or 503), Message(), b""))

    def remove(self) -> None:
        """Remove containers, network and volumes."""
        self._compose("down", "--volumes", check=False)

    def _compose(self, *command: str, check: bool = True, capture_output: bool = True) -> None:
        command = (DOCKER, "compose", "-p", PROJECT, "-f", "docker/compose.yaml", *command)
        done = subprocess.run(
            command, cwd=ROOT, env=self._environment, check=False, capture_output=capture_output, text=True
        )
        if check and done.returncode != 0:
            sys.exit(f"FAILED: {' '.join(command)}\n{done.stderr or ''}")


@contextmanager
def composition(replicas: int, **settings: str) -> Iterator[Composition]:
    """Start the composition with some replicas; it is removed at the end."""
    started = Composition(**settings)
    try:
        started.scale(replicas)
        time.sleep(LEFT_OUT_SECONDS)
        yield started
    finally:
        started.remove()


def frame(
    url: str,
    t: float,
    *,
    scene: str = "toys",
    size: int = 64,
    azimuth: int = 30,
    headers: dict[str, str] | None = None,
) -> Response:
    """Request a frame by GET."""
    link = f"{url}/render?scene={scene}&azimuth={azimuth}&elevation=20&t={t}&width={size}&height={size}"
    return get(link, headers)


def post(url: str, t: float, azimuth: int, request_id: str) -> Response:
    """Request a frame by POST."""
    camera = {"type": "orbit", "azimuth": azimuth, "elevation": 20}
    body = {"scene": "toys", "camera": camera, "t": t, "width": 64, "height": 64}
    headers = {"Content-Type": "application/json", "X-Request-ID": request_id}
    return ask(urllib.request.Request(f"{url}/render", json.dumps(body).encode(), headers))


def video(url: str, file_format: str) -> Response:
    """Request a video of two frames."""
    frames = [{"camera": {"type": "orbit", "azimuth": 30, "elevation": 20}, "t": t} for t in (0.25, 0.5)]
    body = {"scene": "toys", "frames": frames, "width": 64, "height": 64, "format": file_format}
    headers = {"Content-Type": "application/json"}
    return ask(urllib.request.Request(f"{url}/render/video", json.dumps(body).encode(), headers))


def get(url: str, headers: dict[str, str] | None = None) -> Response:
    """Return status and body of a GET; status 0 without a complete response."""
    return ask(urllib.request.Request(url, headers=headers or {}))


def ask(request: urllib.request.Request) -> Response:
    """Return status and body of a request; status 0 without a complete response."""
    direct = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    try:
        try:
            response = direct.open(request, timeout=60)
        except urllib.error.HTTPError as error:
            response = error
        with response:
            return Response(response.status, response.headers, response.read())
    except (OSError, HTTPException):
        return Response(0, Message(), b"")


def wait_for(attempt: Callable[[], Response]) -> Response:
    """Return the first response with status 200."""
    deadline = time.monotonic() + MAX_START_SECONDS
    while time.monotonic() < deadline:
        response = attempt()
        if response.status == 200:
            return response
        time.sleep(0.05)
    sys.exit(f"FAILED: not ready after {MAX_START_SECONDS:.0f} s")


def containers(service: str) -> list[str]:
    """Return the ids of a service's containers."""
    labels = {"com.docker.compose.project": PROJECT, "com.docker.compose.service": service}
    filters = [part for name, value in labels.items() for part in ("--filter", f"label={name}={value}")]
    return output(DOCKER, "ps", "--quiet", *filters).stdout.split()


def log() -> list[dict[str, str]]:
    """Return the proxy's access log."""
    lines = output(DOCKER, "logs", containers("proxy")[0]).stdout.splitlines()
    return [json.loads(line) for line in lines if line.startswith("{")]


def sh(container: str, script: str) -> str:
    """Run a script in a container; returns its output."""
    return output(DOCKER, "exec", container, "sh", "-c", script, check=False).stdout.strip()


def output(*command: str, check: bool = True) -> "subprocess.CompletedProcess[str]":
    """Run a command and capture its output."""
    return subprocess.run(command, check=check, capture_output=True, text=True)


def free_port() -> int:
    """Return a free port of this machine."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def expect(holds: bool, claim: str) -> None:
    """Print a claim that holds; exit if it doesn't."""
    if not holds:
        sys.exit(f"FAILED: {claim}")
    print(f"ok: {claim}")
