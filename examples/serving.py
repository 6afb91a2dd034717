"""Start `msdgs-serve` and ask it for frames, with nothing but the standard library. Both demos use it."""

import contextlib
import json
import shlex
import socket
import subprocess
import sys
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HOST = "127.0.0.1"
START_SECONDS = 600.0  # the first start of a fresh install compiles the kernels, slowly on a busy core
ANSWER_SECONDS = 60.0
LOCAL = urllib.request.build_opener(urllib.request.ProxyHandler({}))  # not through the proxy of `http_proxy`


@contextlib.contextmanager
def serving(scene: Path, port: int, environment: Path = Path(sys.prefix)) -> Iterator[str]:
    """Run the service for one scene file; yields its URL once it answers, and ends it on leaving.

    The service is the one installed in `environment`. Where `port` is taken, a free one is used instead. Raises
    `SystemExit` with the reason if the service ends early.
    """
    port = _free_port(port)
    command = [str(environment / "bin" / "msdgs-serve"), str(scene), "--port", str(port)]
    say(f"$ {shlex.join(command)}")
    url = f"http://{HOST}:{port}"
    process = subprocess.Popen(command)
    try:
        _wait_until_ready(url, process)
        yield url
    finally:
        process.terminate()
        process.wait()


def get(url: str) -> Any:
    """The JSON that a GET answers with."""
    return json.loads(_fetch(urllib.request.Request(url)))


def render(url: str, request: dict[str, Any]) -> bytes:
    """The image file that `POST /render` answers with."""
    body = json.dumps(request).encode()
    return _fetch(urllib.request.Request(f"{url}/render", body, {"Content-Type": "application/json"}))


def stay_up(url: str) -> None:
    """Print the address of the service and return at Ctrl-C."""
    say(f"still listening on {url}, Ctrl-C stops it")
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            time.sleep(3600)


def say(text: str) -> None:
    """Print at once, also into a pipe."""
    print(text, flush=True)


def _fetch(request: urllib.request.Request) -> bytes:
    try:
        with LOCAL.open(request, timeout=ANSWER_SECONDS) as answer:
            return answer.read()
    except urllib.error.HTTPError as error:
        raise SystemExit(f"{request.full_url} answered {error.code}: {error.read().decode()}") from None


def _wait_until_ready(url: str, process: subprocess.Popen[bytes]) -> None:
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise SystemExit(f"the service ended with exit code {process.returncode}")
        with contextlib.suppress(OSError), LOCAL.open(f"{url}/ready", timeout=5):
            return
        time.sleep(0.1)
    raise SystemExit(f"the service did not answer within {START_SECONDS:.0f} s")


def _free_port(wanted: int) -> int:
    for port in (wanted, 0):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((HOST, port))
            return probe.getsockname()[1]
    raise SystemExit(f"no free port on {HOST}")
