"""Serving below a path prefix, behind a proxy that strips it: `--root-path`, or `X-Forwarded-Prefix`."""

import logging
import re
from urllib.parse import quote, unquote

from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware

from msdgs_serve.api.methods import methods_at

HEADER = b"x-forwarded-prefix"
MAX_LENGTH = 256
SEGMENT = re.compile(r"[^/\\\x00-\x1f\x7f-\x9f]+")

logger = logging.getLogger("msdgs_serve")


def read_prefix(text: str) -> str:
    """Return a prefix percent-encoded and without a slash at its end: safe in headers, links and HTML.

    Raises ValueError if it isn't a path from `/`, or has a query, empty segments, `.` or `..`.
    """
    path = text.rstrip("/")
    if not path:
        return ""
    first, *encoded = path.split("/")
    segments = [unquote(each, errors="strict") for each in encoded]
    if first or not segments or "?" in path or "#" in path or len(path) > MAX_LENGTH:
        raise ValueError("not a path")
    if not all(SEGMENT.fullmatch(each) and each not in (".", "..") for each in segments):
        raise ValueError("not a plain path")
    return "".join(f"/{quote(each, safe='')}" for each in segments)


def route_path(scope: Scope) -> str:
    """Return the path of a request without the prefix (ASGI's `root_path`)."""
    path, prefix = scope["path"], scope.get("root_path", "")
    return path.removeprefix(prefix) if f"{path}/".startswith(f"{prefix}/") else path


class BehindProxy(ProxyHeadersMiddleware):
    """ASGI middleware that takes a client's address and scheme and the prefix from headers of trusted proxies."""

    def __init__(self, app: ASGIApp, trusted: str, prefix: str) -> None:
        """`trusted` are addresses of proxies; `prefix` is that of requests without `X-Forwarded-Prefix`."""
        super().__init__(app, trusted)  # pyright: ignore[reportArgumentType]
        self._prefix = prefix

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        if scope["type"] == "http" and (prefix := self._forwarded(scope) or self._prefix):
            _prepend(prefix, scope)
        await super().__call__(scope, receive, send)  # pyright: ignore[reportArgumentType]

    def _forwarded(self, scope: Scope) -> str:
        """Return the prefix in the header: those of several proxies are joined by commas, the outermost first."""
        client, values = scope.get("client"), [value for name, value in scope["headers"] if name == HEADER]
        if not values or (client and client[0]) not in self.trusted_hosts:
            return ""
        try:
            parts = b",".join(values).decode().split(",")
            return read_prefix("".join(read_prefix(part.strip()) for part in parts))
        except ValueError:
            logger.info("X-Forwarded-Prefix ignored, as it isn't a path such as /msdgs: %r", values)
            return ""


def _prepend(prefix: str, scope: Scope) -> None:
    """Put the prefix before the path, as ASGI has it. A proxy may have left it there, but our own paths come first."""
    path, left = scope["path"], unquote(prefix)
    is_left = f"{path}/".startswith(f"{left}/")
    if is_left and not any(methods_at({**scope, "path": ours}) for ours in (path, left)):
        path = path.removeprefix(left)
    scope["path"] = prefix + path
    scope["root_path"] = prefix + scope.get("root_path", "")
