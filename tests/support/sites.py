"""Sites of `msdgs-convert --site`: writing them, serving them as a plain file server does, looking at them."""

import contextlib
import functools
import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from msdgs_export.exporters.command import convert
from msdgs_export.options import ConvertOptions
from msdgs_serve.browser import RUNTIME_MODULES, RUNTIME_WASM
from tests.support.processes import ROOT

MODULES = ROOT / "tests" / "export" / "runtime" / "node_modules"
RUNTIME = MODULES / "onnxruntime-web"

needs_runtime = pytest.mark.skipif(
    not RUNTIME.is_dir(), reason=f"no {MODULES.relative_to(ROOT)}: `make {MODULES.relative_to(ROOT)}`"
)


def stand_in(folder: Path) -> Path:
    """A folder with the files of onnxruntime-web, which contain nothing: for what no browser opens."""
    folder.mkdir()
    for name in (*RUNTIME_MODULES, RUNTIME_WASM):
        (folder / name).write_bytes(b"")
    return folder


def write_site(scene: Path, out: Path, runtime: Path = RUNTIME, console: Console | None = None, **options: Any) -> Path:
    """Write the site of a scene, and return its folder."""
    chosen = ConvertOptions(scene, out, site=True, **{"onnxruntime_web": runtime, **options})
    convert(chosen, console or Console(quiet=True))
    return out


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: Any) -> None:
        """Tell nothing."""


@contextlib.contextmanager
def file_server(folder: Path) -> Iterator[str]:
    """The address of Python's file server for a folder, without a slash at its end."""
    handler = functools.partial(_Quiet, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()
