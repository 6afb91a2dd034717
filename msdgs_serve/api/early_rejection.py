"""Rejection of requests before they are parsed, while the queue is full.

Under 4x overload most requests are rejected, and renders wait for the interpreter meanwhile: goodput is 83 % of the
peak with early rejection and 69 to 76 % without (`benchmarks.service --only overload`).
"""

import time
from collections.abc import Iterable, Mapping

from msdgs_serve.api.errors import RequestRejected, rejection
from msdgs_serve.api.keys import address_of
from msdgs_serve.api.metrics import Metrics
from msdgs_serve.api.observe import IDENTITY, Answered, record, request_id, usable_id
from msdgs_serve.api.work import WorkQueue

METHOD, PATH = "POST", "/render"
START = f"{METHOD} {PATH} HTTP/1.1\r\n".encode()
KNOWN = frozenset(
    name.encode()
    for name in ("accept", "accept-encoding", "accept-language", "content-length", "content-type", "host", "user-agent")
)
Headers = Iterable[tuple[bytes, bytes]]


class EarlyRejection:
    """Rejects simple requests in place of the application while its queue is full.

    A simple request is a `POST /render` that arrives in one piece, with headers that don't affect a rejection.
    Response, access log and metrics are the same as from the application.
    """

    def __init__(self, queue: WorkQueue, metrics: Metrics, max_body_bytes: int) -> None:
        """Bodies of more than `max_body_bytes` are left to the application, which rejects them for their size."""
        self._queue = queue
        self._metrics = metrics
        self._max_body_bytes = max_body_bytes

    def answer(self, data: bytes, client: tuple[str, int] | None, always: Headers) -> bytes | None:
        """Return the response to `data` that a client sent as a new request, or None to pass it to the application.

        `always` are headers of every response.
        """
        if not data.startswith(START):
            return None
        started = time.perf_counter()
        try:
            self._queue.reject_if_full(address_of(client))
        except RequestRejected as error:
            refused = error
        else:
            return None
        head, _, body = data[len(START) :].partition(b"\r\n\r\n")
        headers = _known_headers(head)
        if headers.get(b"content-length") != b"%d" % len(body) or len(body) > self._max_body_bytes:
            return None
        identity = usable_id(headers.get(IDENTITY, b""))
        token = request_id.set(identity)
        try:
            response = rejection(refused)
            seconds = time.perf_counter() - started
            answered = Answered(METHOD, PATH, PATH, response.status_code, refused.kind, seconds, len(response.body))
            record(self._metrics, answered, client)
        finally:
            request_id.reset(token)
        lines = [*always, *response.raw_headers, (IDENTITY, identity.encode())]
        status = f"HTTP/1.1 {refused.status.value} {refused.status.phrase}\r\n".encode()
        return status + b"".join(b"%s: %s\r\n" % line for line in lines) + b"\r\n" + bytes(response.body)


def _known_headers(head: bytes) -> Mapping[bytes, bytes]:
    """Return headers by lower-case name; none if any of them is malformed, repeated or not in `KNOWN`."""
    found: dict[bytes, bytes] = {}
    for line in head.split(b"\r\n"):
        name, colon, value = line.partition(b":")
        name, value = name.lower(), value.strip(b" \t")
        plain = name in KNOWN or name == IDENTITY or (name, value.lower()) == (b"connection", b"keep-alive")
        if not colon or not plain or name in found or not value.decode("latin-1").isprintable():
            return {}
        found[name] = value
    return found if b"host" in found else {}
