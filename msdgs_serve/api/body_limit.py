"""Refuse bodies that are too large, without keeping them in memory."""

from http import HTTPStatus

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from msdgs_serve.api.errors import FieldError, problem_response

DRAINED_BYTES = 64 << 20
"""Of a body that is too large this much is read and thrown away: most clients look for an answer only after sending."""


class BodyLimit:
    """ASGI middleware: 413 for a body of more than `max_bytes`, whether its length is announced or not."""

    def __init__(self, app: ASGIApp, max_bytes: int) -> None:
        self._app = app
        self._max_bytes = max_bytes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        body = await self._read(receive)
        if isinstance(body, bytes):
            await self._app(scope, _replay(body, receive), send)
        elif body:
            message = f"must be at most {self._max_bytes} bytes"
            errors = [FieldError(field="body", message=message)]
            response = problem_response(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"The body {message}.", errors)
            await response(scope, receive, send)

    async def _read(self, receive: Receive) -> bytes | bool:
        """The body; True where it is too large; False where the client went away."""
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


def _replay(body: bytes, receive: Receive) -> Receive:
    """A `receive` that first gives the whole body, then what comes after it."""
    given = False

    async def replayed() -> Message:
        nonlocal given
        if given:
            return await receive()
        given = True
        return {"type": "http.request", "body": body, "more_body": False}

    return replayed
