"""Keys: who has none is answered 401, on every route but the health checks and the page, which asks for one."""

import hashlib
import hmac
from collections.abc import Iterable
from http import HTTPStatus
from pathlib import Path

from starlette.types import ASGIApp, Receive, Scope, Send

from msdgs_serve.api.errors import KIND, problem_response
from msdgs_serve.api.prefix import route_path
from msdgs_serve.scene import InvalidInput

OPEN_PATHS = ("/live", "/ready", "/")
OPEN_FOLDER = "/viewer/"
SHORTEST_KEY = 16
CLIENT = "msdgs.client"
"""Key of an ASGI scope: whose key was used."""


def client_of(scope: Scope) -> str:
    """Who calls, for what is shared out among clients: a key, or else an address."""
    return scope.get(CLIENT) or address_of(scope.get("client"))


def address_of(client: tuple[str, int] | None) -> str:
    """Of a connection, or of whom a trusted proxy names."""
    return client[0] if client else "unknown"


class KeyCheck:
    """ASGI middleware. The key comes as `Authorization: Bearer …` or as `X-API-Key`.

    Digests are compared, in constant time, and always with all keys: how long it takes tells nothing.
    """

    def __init__(self, app: ASGIApp, keys: Iterable[str]) -> None:
        self._app = app
        self._digests = [_digest(key.encode()) for key in keys]

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or _is_open(route_path(scope)) or self._fits(scope):
            await self._app(scope, receive, send)
            return
        scope[KIND] = "unauthorized"
        detail = "A key is needed: `Authorization: Bearer <key>` or `X-API-Key: <key>`."
        response = problem_response(HTTPStatus.UNAUTHORIZED, detail, headers={"WWW-Authenticate": "Bearer"})
        await response(scope, receive, send)

    def _fits(self, scope: Scope) -> bool:
        headers = dict(scope["headers"])
        kind, _, bearer = headers.get(b"authorization", b"").partition(b" ")
        given = bearer.strip() if kind.lower() == b"bearer" else headers.get(b"x-api-key", b"")
        digest = _digest(given)
        return sum([hmac.compare_digest(digest, known) for known in self._digests]) > 0


def _is_open(path: str) -> bool:
    return path in OPEN_PATHS or path.startswith(OPEN_FOLDER)


def read_keys(path: Path) -> list[str]:
    """One key a line; empty lines and those that begin with # don't count. Raises `InvalidInput`."""
    try:
        lines = [line.strip() for line in path.read_text().splitlines()]
    except (OSError, UnicodeDecodeError):
        raise InvalidInput("api_keys_file", "a text file that can be read", path) from None
    keys = [line for line in lines if line and not line.startswith("#")]
    if not keys or any(len(key) < SHORTEST_KEY for key in keys):
        raise InvalidInput("api_keys_file", f"keys of {SHORTEST_KEY} or more letters, one a line", f"{len(keys)} keys")
    return keys


def _digest(key: bytes) -> bytes:
    return hashlib.sha256(key).digest()
