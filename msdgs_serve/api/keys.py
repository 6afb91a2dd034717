"""API keys and their scopes: 401 without a key, 403 without the scope. Health checks and the viewer need none."""

import hashlib
import hmac
import re
from collections.abc import Iterable
from http import HTTPStatus
from pathlib import Path
from typing import Literal, NamedTuple, get_args

from starlette.types import ASGIApp, Receive, Scope, Send

from msdgs_serve.api.errors import KIND, problem_response
from msdgs_serve.api.prefix import route_path
from msdgs_serve.scene import InvalidInput

KeyScope = Literal["read", "write", "operate"]
"""read: frames, scenes, documentation. write: add, replace and delete scenes. operate: metrics."""

SCOPES: tuple[KeyScope, ...] = get_args(KeyScope)
OPEN_PATHS = ("/live", "/ready", "/", "")
OPEN_FOLDER = "/viewer/"
OPERATED_PATHS = ("/metrics",)
WRITTEN_PATH, WRITTEN_FOLDER = "/scenes", "/scenes/"
MIN_KEY_LENGTH = 16
MAX_BYTES = 1 << 20
CLIENT = "msdgs.client"
"""Key of an ASGI scope for the client: the first digits of the digest of its API key."""
CLIENT_DIGITS = 16

LINE = re.compile(rf"(?P<scopes>\w+(,\w+)*)[ \t]+(?P<key>\S{{{MIN_KEY_LENGTH},}})")


class Key(NamedTuple):
    """An API key: a line of the file of keys."""

    digest: bytes
    scopes: frozenset[str]

    @property
    def client(self) -> str:
        """Identifier of the client, which doesn't reveal the key."""
        return self.digest.hex()[:CLIENT_DIGITS]


def client_of(scope: Scope) -> str:
    """Return the identifier of a client, by which resources are shared: its key, or else its address, which a trusted
    proxy may forward."""
    return scope.get(CLIENT) or (scope.get("client") or ("unknown",))[0]


def scope_of(method: str, path: str) -> KeyScope | None:
    """Return the scope that a call needs, or None if it needs no key."""
    if path in OPEN_PATHS or path.startswith(OPEN_FOLDER):
        return None
    if path in OPERATED_PATHS:
        return "operate"
    if (path == WRITTEN_PATH or path.startswith(WRITTEN_FOLDER)) and method not in ("GET", "HEAD", "OPTIONS"):
        return "write"
    return "read"


class KeyCheck:
    """ASGI middleware that checks the key in `Authorization: Bearer …` or `X-API-Key`.

    Digests of all keys are compared in constant time, so that timing reveals nothing.
    """

    def __init__(self, app: ASGIApp, keys: Iterable[Key]) -> None:
        self._app = app
        self._keys = list(keys)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        needed = scope_of(scope["method"], route_path(scope)) if scope["type"] == "http" else None
        if needed is not None:
            key = self._key(scope)
            if key is None:
                scope[KIND] = "unauthorized"
                detail = "A key is needed: `Authorization: Bearer <key>` or `X-API-Key: <key>`."
                response = problem_response(HTTPStatus.UNAUTHORIZED, detail, headers={"WWW-Authenticate": "Bearer"})
                await response(scope, receive, send)
                return
            if needed not in key.scopes:
                scope[KIND] = "forbidden"
                detail = f"This key lacks the scope `{needed}`; it has {', '.join(sorted(key.scopes))}."
                await problem_response(HTTPStatus.FORBIDDEN, detail)(scope, receive, send)
                return
            scope[CLIENT] = key.client
        await self._app(scope, receive, send)

    def _key(self, scope: Scope) -> Key | None:
        headers = dict(scope["headers"])
        kind, _, bearer = headers.get(b"authorization", b"").partition(b" ")
        given = bearer.strip() if kind.lower() == b"bearer" else headers.get(b"x-api-key", b"")
        digest = _digest(given)
        fitting = [key for key in self._keys if hmac.compare_digest(digest, key.digest)]
        return fitting[0] if fitting else None


def read_keys(path: Path) -> list[Key]:
    """Read lines of comma-separated scopes and a key; empty lines and those that begin with # are ignored.

    Raises `InvalidInput` naming the invalid line, without revealing keys.
    """
    try:
        with path.open("rb") as file:
            contents = file.read(MAX_BYTES + 1)
        lines = contents.decode("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError):
        raise InvalidInput("api_keys_file", "a readable text file in UTF-8", path) from None
    if len(contents) > MAX_BYTES:
        raise InvalidInput("api_keys_file", f"at most {MAX_BYTES} bytes", f"{path}, which is larger")
    texts = [(number, line.strip()) for number, line in enumerate(lines, 1)]
    keys = [_key_of(number, text) for number, text in texts if text and not text.startswith("#")]
    if len({key.digest for key in keys}) < len(keys) or not keys:
        raise InvalidInput("api_keys_file", "a file of different keys, one per line", f"{len(keys)} keys")
    return keys


def _key_of(number: int, text: str) -> Key:
    match = LINE.fullmatch(text)
    scopes = frozenset(match["scopes"].split(",")) if match else frozenset()
    if match is None or not scopes <= set(SCOPES):
        form = f"`scopes key`, as in `{','.join(SCOPES)} <a key of {MIN_KEY_LENGTH} or more characters>`"
        got = "a key without scopes" if " " not in text and "\t" not in text else "another line"
        raise InvalidInput(f"api_keys_file, line {number}", form, got)
    return Key(_digest(match["key"].encode()), scopes)


def _digest(key: bytes) -> bytes:
    return hashlib.sha256(key).digest()
