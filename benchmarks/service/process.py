"""`msdgs-serve` in a process of its own, and scenes to serve."""

import http.client
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any, NamedTuple

from tests.support.processes import free_port, wait_for
from tests.support.scene_files import write_scene

START_SECONDS = 120
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
        with closing(Connection(self.port)) as connection:
            return connection.ask(method, path, body)

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


@contextmanager
def service(*scenes: Path, **flags: Any) -> Iterator[Running]:
    """Run `msdgs-serve` with these scenes until the end of the block, and wait until it is ready; `flag=value` stands
    for `--flag value`, `flag=True` for `--flag`."""
    port = free_port()
    options = [
        text for name, value in {"port": port, **flags}.items()
        for text in (f"--{name.replace('_', '-')}", *([] if value is True else [str(value)]))
    ]  # fmt: skip
    command = [sys.executable, "-c", PROGRAM, *map(str, scenes), *options]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL) as process:
        running = Running(port, process)
        try:
            wait_for(lambda: _is_ready(running), START_SECONDS)
            yield running
        finally:
            process.terminate()
            process.wait()


def _is_ready(running: Running) -> bool:
    """Whether scenes are loaded and kernels are compiled."""
    if running.process.poll() is not None:
        raise SystemExit("the service has ended")
    with suppress(OSError, http.client.HTTPException):
        return running.ask("GET", "/ready").status == 200
    return False


def make_scenes(folder: Path, scene: Path) -> Path:
    """A folder of three scenes: the given one, a copy of it, and two small balls."""
    folder.mkdir()
    for name in ("first", "second"):
        shutil.copyfile(scene, folder / f"{name}.onnx")
    write_scene(folder / "balls.onnx")
    return folder
