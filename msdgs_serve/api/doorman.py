"""Calls that are refused before anybody has parsed them.

Under four times too much load most calls are refused, and frames wait for the interpreter meanwhile: of the frames that
the service draws at its peak, 82 % are still answered with the doorman and 74 % without (`benchmarks/service.py --only
overload`).
"""

import time
from collections.abc import Iterable, Mapping

from msdgs_serve.api.errors import Refused, refusal
from msdgs_serve.api.metrics import Metrics
from msdgs_serve.api.observe import REQUEST_ID, Answered, record, request_id, usable_id
from msdgs_serve.api.work import WorkQueue

METHOD, PATH = "POST", "/render"
START = f"{METHOD} {PATH} HTTP/1.1\r\n".encode()
KNOWN = frozenset(
    name.encode()
    for name in ("accept", "accept-encoding", "accept-language", "content-length", "content-type", "host", "user-agent")
)
IDENTITY = REQUEST_ID.lower().encode()
Headers = Iterable[tuple[bytes, bytes]]


class Doorman:
    """Answers for the application while its queue is full, where a call is of the plainest kind.

    That is `POST /render` that comes whole, in one piece, with headers that change nothing about a refusal. It gets the
    same answer, line in the log and counts as from the application.
    """

    def __init__(self, queue: WorkQueue, metrics: Metrics) -> None:
        self._queue = queue
        self._metrics = metrics

    def answer(self, data: bytes, client: tuple[str, int] | None, always: Headers) -> bytes | None:
        """What to write to a connection that has sent `data` between two calls, with the headers `always`.

        None: `data` is for the application.
        """
        if not data.startswith(START):
            return None
        started = time.perf_counter()
        try:
            self._queue.refuse_if_full()
        except Refused as error:
            refused = error
        else:
            return None
        head, _, body = data[len(START) :].partition(b"\r\n\r\n")
        headers = _known_headers(head)
        if headers is None or headers.get(b"content-length") != b"%d" % len(body):
            return None
        identity = usable_id(headers.get(IDENTITY, b""))
        token = request_id.set(identity)
        try:
            response = refusal(refused)
            seconds = time.perf_counter() - started
            answered = Answered(METHOD, PATH, PATH, response.status_code, refused.kind, seconds, len(response.body))
            record(self._metrics, answered, client)
        finally:
            request_id.reset(token)
        lines = [*always, *response.raw_headers, (IDENTITY, identity.encode())]
        status = f"HTTP/1.1 {refused.status.value} {refused.status.phrase}\r\n".encode()
        return status + b"".join(b"%s: %s\r\n" % line for line in lines) + b"\r\n" + bytes(response.body)


def _known_headers(head: bytes) -> Mapping[bytes, bytes] | None:
    """By names in small letters; None where one is missing, is there twice or isn't known to change nothing."""
    found: dict[bytes, bytes] = {}
    for line in head.split(b"\r\n"):
        name, colon, value = line.partition(b":")
        name, value = name.lower(), value.strip(b" \t")
        plain = name in KNOWN or name == IDENTITY or (name, value.lower()) == (b"connection", b"keep-alive")
        if not colon or not plain or name in found:
            return None
        found[name] = value
    return found if b"host" in found else None
