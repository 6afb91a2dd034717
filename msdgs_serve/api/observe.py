"""Around every request: an id, a line in the log, a count in the metrics, and a problem where nothing else answers."""

import contextvars
import json
import logging
import random
import re
import time
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from msdgs_serve.api.errors import KIND, server_error
from msdgs_serve.api.metrics import Metrics

REQUEST_ID = "X-Request-ID"
USABLE_ID = re.compile(r"[A-Za-z0-9._-]{1,64}")
FIRST_ERROR = 400
UNKNOWN_METHOD = "other"
METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")

request_id: contextvars.ContextVar[str | None] = contextvars.ContextVar("request_id", default=None)
logger = logging.getLogger("msdgs_serve")
access_log = logging.getLogger("msdgs_serve.access")


class Observe:
    """ASGI middleware, the outermost. A client's own `X-Request-ID` is kept where it is short and plain."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self._app = app
        self._metrics = metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        token = request_id.set(_id_of(scope))
        answer = _Answer(send)
        started = time.perf_counter()
        try:
            await self._app(scope, receive, answer.send)
        except Exception as error:
            logger.error("%s %s failed", scope["method"], scope["path"], exc_info=error)
            scope[KIND] = "internal"
            if answer.status is not None:
                raise  # too late for an answer; the server closes the connection
            await server_error()(scope, receive, answer.send)
        finally:
            self._record(scope, answer, time.perf_counter() - started)
            request_id.reset(token)

    def _record(self, scope: Scope, answer: "_Answer", seconds: float) -> None:
        status = answer.status or 0
        method = scope["method"] if scope["method"] in METHODS else UNKNOWN_METHOD
        route = getattr(scope.get("route"), "path", "unmatched")
        self._metrics.count_request(method, route, status, seconds, answer.sent)
        if status >= FIRST_ERROR:
            self._metrics.count_problem(scope.get(KIND) or f"status_{status}")
        facts = {
            "method": method,
            "path": scope["path"],
            "status": status,
            "milliseconds": round(1000 * seconds, 2),
            "bytes": answer.sent,
            "client": (scope.get("client") or ("unknown",))[0],
        }
        access_log.info("%s %s %d", method, scope["path"], status, extra={"facts": facts})


class _Answer:
    """Sends on, with the request's id among the headers, and remembers what was sent."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self.status: int | None = None
        self.sent = 0

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self.status = message["status"]
            header = (REQUEST_ID.lower().encode(), (request_id.get() or "").encode())
            message = {**message, "headers": [*message.get("headers", ()), header]}
        else:
            self.sent += len(message.get("body", b""))
        await self._send(message)


class JsonLines(logging.Formatter):
    """A log record as one line of JSON."""

    def format(self, record: logging.LogRecord) -> str:
        """With the request's id, and what the access log knows of the request."""
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


def _id_of(scope: Scope) -> str:
    given = dict(scope["headers"]).get(REQUEST_ID.lower().encode(), b"").decode("latin-1")
    return given if USABLE_ID.fullmatch(given) else f"{random.getrandbits(128):032x}"
