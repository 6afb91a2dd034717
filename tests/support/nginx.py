"""nginx as a process of this machine."""

import contextlib
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.support.processes import free_port, wait_for

PROGRAM = shutil.which("nginx", path="/usr/sbin:/usr/local/sbin:/usr/bin:/usr/local/bin")
needs_nginx = pytest.mark.skipif(PROGRAM is None, reason="there is no nginx to run")
FOLDERS = "".join(f"{name}_temp_path {name};\n" for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi"))


@contextlib.contextmanager
def nginx(folder: Path, locations: str) -> Iterator[httpx.Client]:
    """Yield a client of a server with these locations, which keeps its files in a folder and ends with the block."""
    assert PROGRAM is not None
    port, file = free_port(), folder / "nginx.conf"
    server = f"server {{ listen 127.0.0.1:{port};\n{locations}\n}}"
    http = f"http {{ access_log off;\n{FOLDERS}{server} }}"
    file.write_text(f"daemon off; master_process off; pid pid; error_log errors; events {{}}\n{http}\n")
    command = [PROGRAM, "-p", folder, "-e", "errors", "-c", file]
    with subprocess.Popen(command) as process, httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=60) as client:

        def listens() -> bool:
            assert process.poll() is None, (folder / "errors").read_text()
            with contextlib.suppress(httpx.ConnectError):
                return bool(client.get("/anything").status_code)
            return False

        try:
            wait_for(listens)
            yield client
        finally:
            process.terminate()
