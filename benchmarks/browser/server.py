"""A file server for the pages of the benchmark."""

import contextlib
import threading
from collections.abc import Iterator, Mapping
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

ISOLATION = {"Cross-Origin-Opener-Policy": "same-origin", "Cross-Origin-Embedder-Policy": "require-corp"}
"""Headers without which a page can't measure its memory."""


@contextlib.contextmanager
def serving(folders: Mapping[str, Path]) -> Iterator[str]:
    """The address of a server that has each folder below its name."""

    class Handler(SimpleHTTPRequestHandler):
        def translate_path(self, path: str) -> str:
            name, _, rest = unquote(urlsplit(path).path).lstrip("/").partition("/")
            return str(folders[name] / rest) if name in folders else ""

        def end_headers(self) -> None:
            for header, value in ISOLATION.items():
                self.send_header(header, value)
            super().end_headers()

        def log_message(self, format: str, *args: Any) -> None:
            """Tell nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        thread = threading.Thread(target=server.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()
