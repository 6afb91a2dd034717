"""`msdgs-serve` in a process of its own, and scenes to serve."""

import http.client
import json
import os
import re
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from tests.support.processes import free_port
from tests.support.scene_files import write_scene

NGINX = Path(__file__).resolve().parents[2] / "docker" / "nginx" / "nginx.conf"
START_SECONDS = 120
MOMENT = 0.01
PROGRAM = "import sys; from msdgs_serve.api.cli import main; sys.exit(main())"
JSON = {"Content-Type": "application/json"}
NONE: dict[str, str] = {}


class Answer(NamedTuple):
    """An answer."""

    status: int
    headers: dict[str, str]  # names in lower case
    body: bytes


class Connection:
    """A connection to a port of this machine, opened again if the service has closed it."""

    def __init__(self, port: int) -> None:
        self._http = http.client.HTTPConnection("127.0.0.1", port, timeout=120)

    def ask(self, method: str, path: str, body: Any = None, headers: dict[str, str] | None = None) -> Answer:
        """Send a request with a JSON body, if one is given."""
        if body is None:
            return self.send(method, path, None, headers or {})
        return self.send(method, path, json.dumps(body).encode(), {**JSON, **(headers or {})})

    def send(self, method: str, path: str, content: bytes | None, headers: dict[str, str] = NONE) -> Answer:
        """Send raw bytes; once more if the service has closed the connection, as it does after 5 idle seconds."""
        try:
            return self._once(method, path, content, headers)
        except (BrokenPipeError, ConnectionResetError, http.client.RemoteDisconnected):
            self._http.close()
            return self._once(method, path, content, headers)

    def _once(self, method: str, path: str, content: bytes | None, headers: dict[str, str]) -> Answer:
        self._http.request(method, path, content, headers)
        response = self._http.getresponse()
        return Answer(response.status, {k.lower(): v for k, v in response.getheaders()}, response.read())

    def close(self) -> None:
        self._http.close()


class Running(NamedTuple):
    """A service that is ready."""

    port: int
    process: subprocess.Popen

    def ask(self, method: str, path: str, body: Any = None) -> Answer:
        """Send a request on a new connection."""
        connection = Connection(self.port)
        try:
            return connection.ask(method, path, body)
        finally:
            connection.close()

    def metric(self, name: str) -> float:
        """The value of a metric without labels."""
        text = self.ask("GET", "/metrics").body.decode()
        found = re.search(rf"^{name} (\S+)$", text, re.MULTILINE)
        assert found, name
        return float(found[1])

    def resident_bytes(self) -> int:
        """Resident memory of the process (Linux)."""
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        found = re.search(r"^VmRSS:\s+(\d+) kB", status, re.MULTILINE)
        assert found
        return int(found[1]) << 10

    def processor_seconds(self) -> float:
        """Processor time of all threads of the process (Linux)."""
        user, system = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()[11:13]
        return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def service(*scenes: Path, **flags: Any) -> AbstractContextManager[Running]:
    """Run `msdgs-serve` with these scenes; `flag=value` stands for `--flag value`, `flag=True` for `--flag`."""
    port = free_port()
    options = [
        text for name, value in flags.items()
        for text in (f"--{name.replace('_', '-')}", *([] if value is True else [str(value)]))
    ]  # fmt: skip
    return _running([sys.executable, "-c", PROGRAM, *map(str, scenes), "--port", str(port), *options], port)


@contextmanager
def _running(command: Sequence[str], port: int) -> Iterator[Running]:
    """A process that is ready at a port, terminated at the end of the block."""
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        try:
            running = Running(port, process)
            wait_until_ready(running)
            yield running
        finally:
            process.terminate()
            process.wait()


def wait_until_ready(running: Running) -> None:
    """Wait until scenes are loaded and kernels are compiled."""
    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline and running.process.poll() is None:
        with suppress(OSError, http.client.HTTPException):
            if running.ask("GET", "/ready").status == 200:
                return
        time.sleep(MOMENT)
    raise SystemExit("the service did not become ready")


@contextmanager
def proxy(running: Sequence[Running], work: Path) -> Iterator[int]:
    """The port of nginx with docker/'s settings in front of these services; needs `nginx` (Debian: nginx-light)."""
    program = shutil.which("nginx", path=f"{os.environ['PATH']}:/usr/sbin")
    if program is None:
        raise SystemExit("nginx is not installed; on Debian: apt-get install nginx-light")
    port, folder = free_port(), work / "nginx"
    folder.mkdir()
    settings = NGINX.read_text().replace("listen 8080", f"listen {port}").replace("/tmp/", f"{folder}/")
    (folder / "nginx.conf").write_text(settings)
    (folder / "replicas.conf").write_text("".join(f"server 127.0.0.1:{each.port} max_fails=0;\n" for each in running))
    user = "user root;" if os.geteuid() == 0 else ""  # or the worker couldn't enter `work`
    command = [program, "-c", str(folder / "nginx.conf"), "-g", f"daemon off; {user}"]
    with _running(command, port):
        yield port


def make_scenes(folder: Path, scene: Path) -> Path:
    """A folder of three scenes: the given one, a copy of it, and two small balls."""
    folder.mkdir()
    for name in ("first", "second"):
        shutil.copyfile(scene, folder / f"{name}.onnx")
    write_scene(folder / "balls.onnx")
    return folder
