"""Middleware for every request: request id, access log, metrics, and the response to unhandled errors."""

import contextvars
import json
import logging
import random
import re
import time
from typing import Any
from urllib.parse import quote

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from msdgs_serve.api.errors import KIND, server_error
from msdgs_serve.api.methods import METHODS
from msdgs_serve.api.metrics import Metrics
from msdgs_serve.api.prefix import route_path

REQUEST_ID = "X-Request-ID"
IDENTITY = REQUEST_ID.lower().encode()  # as ASGI names it
USABLE_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
FIRST_ERROR = 400
UNKNOWN_METHOD = "other"

request_id: contextvars.ContextVar[str | None] = contextvars.ContextVar("request_id", default=None)
logger = logging.getLogger("msdgs_serve")
access_log = logging.getLogger("msdgs_serve.access")


class Observe:
    """ASGI middleware around all that answers. Keeps a client's `X-Request-ID` if it is valid."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        token = request_id.set(_usable_id(dict(scope["headers"]).get(IDENTITY, b"")))
        answer, path = _Answer(send), route_path(scope)
        started = time.perf_counter()
        try:
            await self._app(scope, receive, answer.send)
        except Exception as error:
            logger.error("%s %s failed", scope["method"], quote(path), exc_info=error)
            scope[KIND] = "internal"
            if answer.status is not None:
                raise  # the response has started: the server closes the connection
            await server_error()(scope, receive, answer.send)
        finally:
            self._record(scope, path, answer, time.perf_counter() - started)
            request_id.reset(token)

    def _record(self, scope: Scope, path: str, answer: "_Answer", seconds: float) -> None:
        """Count and log a request."""
        method = scope["method"] if scope["method"] in METHODS else UNKNOWN_METHOD
        route = getattr(scope.get("route"), "path", "unmatched")
        status, kind = answer.status or 0, scope.get(KIND)  # 0: there was no response
        self._metrics.count_request(method, route, status, seconds, answer.sent)
        if kind is not None or status >= FIRST_ERROR:  # a kind with status 200: it was cut off
            self._metrics.count_problem(kind or f"status_{status}")
        facts = {
            "method": method,
            "path": path,
            "status": status,
            "milliseconds": round(1000 * seconds, 2),
            "bytes": answer.sent,
            "client": (scope.get("client") or ("unknown",))[0],
        }
        access_log.info("%s %s %d", method, quote(path), status, extra={"facts": facts})


class _Answer:
    """Forwards a response with the request's id as a header, and records status and bytes sent."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self.status: int | None = None
        self.sent = 0

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
            header = (IDENTITY, (request_id.get() or "").encode())
            message = {**message, "headers": [*message.get("headers", ()), header]}
        else:
            self.sent += len(message.get("body", b""))
        await self._send(message)


class JsonLines(logging.Formatter):
    """A log record as one line of JSON."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record as JSON, with the request's id and the fields of the access log."""
        line: dict[str, Any] = {
            "time": self.formatTime(record, "%Y-%m-%dT%H:%M:%S") + f".{int(record.msecs):03d}",
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **getattr(record, "facts", {}),
        }
        if identity := request_id.get():
            line["request_id"] = identity
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line)


def _usable_id(given: bytes) -> str:
    """Return a client's request id, or a new one if it isn't valid."""
    text = given.decode("latin-1")
    return text if USABLE_ID.fullmatch(text) else f"{random.getrandbits(128):032x}"
