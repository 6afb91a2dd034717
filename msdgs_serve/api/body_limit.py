"""Reject request bodies that are too large, too slow or compressed, without keeping them in memory."""

import asyncio
from collections.abc import Collection
from http import HTTPStatus

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from msdgs_serve.api.errors import KIND, FieldError, problem_response
from msdgs_serve.api.prefix import route_path

DRAINED_BYTES = 64 << 20
"""Bytes of a body that is too large to read and discard: most clients read the response only after sending."""

HEADERS = {
    HTTPStatus.REQUEST_TIMEOUT: {"Connection": "close"},
    HTTPStatus.UNSUPPORTED_MEDIA_TYPE: {"Accept-Encoding": "identity"},
}


class BodyLimit:
    """ASGI middleware: 413 for a body of more than `max_bytes`, 408 for one that takes longer than `seconds`, 415 for
    one with a content coding.

    Routes in `streamed`, as (method, path), read their bodies themselves, with limits of their own.
    """

    def __init__(
        self, app: ASGIApp, max_bytes: int, seconds: float, streamed: Collection[tuple[str, str]] = ()
    ) -> None:
        self._app = app
        self._max_bytes = max_bytes
        self._seconds = seconds
        self._streamed = streamed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "http" and scope["method"] == "POST" and (codings := _codings(scope)):
            message = f"must be sent without Content-Encoding, got {codings}"
            await _reject(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, message, "encoded_body", scope, receive, send)
            return
        if scope["type"] != "http" or (scope["method"], route_path(scope)) in self._streamed:
            await self._app(scope, receive, send)
            return
        try:
            async with asyncio.timeout(self._seconds):
                body = await self._read(receive)
        except TimeoutError:
            message = f"must be complete within {self._seconds:g} s"
            await _reject(HTTPStatus.REQUEST_TIMEOUT, message, "slow_body", scope, receive, send)
            return
        if isinstance(body, bytes):
            await self._app(scope, _replay(body, receive), send)
        elif body:
            message = f"must be at most {self._max_bytes} bytes"
            await _reject(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, message, "large_body", scope, receive, send)

    async def _read(self, receive: Receive) -> bytes | bool:
        """Return the body, True if it is too large, or False if the client disconnected."""
        parts: list[bytes] = []
        size = 0
        while size <= DRAINED_BYTES:
            message = await receive()
            if message["type"] != "http.request":
                return False
            part = message.get("body", b"")
            size += len(part)
            if size <= self._max_bytes:
                parts.append(part)
            else:
                parts.clear()
            if not message.get("more_body", False):
                break
        return b"".join(parts) if size <= self._max_bytes else True


async def _reject(status: HTTPStatus, message: str, kind: str, scope: Scope, receive: Receive, send: Send) -> None:
    scope[KIND] = kind
    errors = [FieldError(field="body", message=message)]
    await problem_response(status, f"The body {message}.", errors, HEADERS.get(status))(scope, receive, send)


def _codings(scope: Scope) -> str:
    """Return the content codings of a body but `identity`, joined by commas."""
    given = b",".join(value for name, value in scope["headers"] if name == b"content-encoding").decode("latin-1")
    codings = (each.strip() for each in given.split(","))
    return ", ".join(each for each in codings if each.lower() not in ("", "identity"))


def _replay(body: bytes, receive: Receive) -> Receive:
    """Return a `receive` that first returns the whole body, then the messages after it."""
    given = False

    async def replayed() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return replayed
