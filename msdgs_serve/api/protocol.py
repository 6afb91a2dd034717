"""uvicorn's HTTP/1.1 protocol with time limits on request headers and on clients that read their responses too slowly.

The head of a response is written together with the first part of its body. Each write wakes up the client, which may
preempt the event loop while that holds Python's interpreter: under 4x overload 10 % more frames are answered.
"""

import asyncio
import http
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from msdgs_serve.api.errors import MEDIA_TYPE, problem_response

READ_BYTES = 1 << 16
"""Bytes of its response, or all that are left, that a client reads in each `read_seconds`."""


class LimitedProtocol(H11Protocol):
    """Closes connections whose headers take longer than `header_seconds` or that read less than `READ_BYTES` in
    `read_seconds`. The rest of a body that was answered before it was complete has `header_seconds` too."""

    def __init__(self, *arguments: Any, header_seconds: float, read_seconds: float, **keywords: Any) -> None:
        super().__init__(*arguments, **keywords)
        self.conn = _HeadWithBody(h11.SERVER)
        self._header_seconds = header_seconds
        self._read_seconds = read_seconds
        self._header_timer: asyncio.TimerHandle | None = None
        self._read_timer: asyncio.TimerHandle | None = None
        self._unsent = 0

    @property
    def unsent_bytes(self) -> int:
        """Bytes of its response that the client hasn't read yet."""
        return self.transport.get_write_buffer_size()

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Start the time limit of the first headers."""
        super().connection_made(transport)
        self._start_header_timer()

    def data_received(self, data: bytes) -> None:
        """Stop the time limit when the headers are complete, and start one for what no application reads."""
        is_rest = self.conn.our_state is h11.DONE
        super().data_received(data)
        if not self._is_unread() or (is_rest and self.conn.their_state is h11.IDLE):
            self._header_timer = _cancelled(self._header_timer)
        if self._is_unread() and self._header_timer is None and not self.transport.is_closing():
            self._start_header_timer()

    def connection_lost(self, exc: Exception | None) -> None:
        """Cancel all timers."""
        self._header_timer = _cancelled(self._header_timer)
        self._read_timer = _cancelled(self._read_timer)
        super().connection_lost(exc)

    def pause_writing(self) -> None:
        """Start checking whether the client reads."""
        super().pause_writing()
        self._start_read_timer()

    def resume_writing(self) -> None:
        """Stop checking, as the client has read nearly everything."""
        self._read_timer = _cancelled(self._read_timer)
        super().resume_writing()

    def timeout_keep_alive_handler(self) -> None:
        """Close an idle connection, even if the client hasn't read all of its response."""
        super().timeout_keep_alive_handler()
        self._start_read_timer()

    def send_400_response(self, msg: str) -> None:
        """Answer invalid HTTP with a problem."""
        self._send_problem(http.HTTPStatus.BAD_REQUEST, "Not a valid HTTP/1.1 request, or its headers are too long.")

    def _is_unread(self) -> bool:
        """Whether no application reads what the client sends: headers, or the rest of a body after the response."""
        return self.conn.their_state is h11.IDLE or self.conn.our_state is h11.DONE

    def _start_header_timer(self) -> None:
        self._header_timer = self.loop.call_later(self._header_seconds, self._on_headers_late)

    def _on_headers_late(self) -> None:
        self._header_timer = None
        if not self.transport.is_closing() and self._is_unread():
            detail = f"The headers must be complete within {self._header_seconds:g} s."
            self._send_problem(http.HTTPStatus.REQUEST_TIMEOUT, detail)

    def _start_read_timer(self) -> None:
        if self._read_timer is not None:
            return
        self._unsent = self.unsent_bytes
        if self._unsent:
            self._read_timer = self.loop.call_later(self._read_seconds, self._check_reading)

    def _check_reading(self) -> None:
        self._read_timer = None
        if self.unsent_bytes > self._unsent - READ_BYTES:
            self.transport.abort()
        else:
            self._start_read_timer()

    def _send_problem(self, status: http.HTTPStatus, detail: str) -> None:
        if self.conn.our_state in (h11.IDLE, h11.SEND_RESPONSE):
            body = problem_response(status, detail).body
            head = f"HTTP/1.1 {status.value} {status.phrase}\r\nContent-Type: {MEDIA_TYPE}\r\n"
            head += f"Content-Length: {len(body)}\r\nConnection: close\r\n\r\n"
            self.transport.write(head.encode() + bytes(body))
        self.transport.close()
        self._start_read_timer()


class _HeadWithBody(h11.Connection):
    """Delays the head of a response until the next part of it is sent."""

    _head = b""

    def send(self, event: h11.Event) -> bytes | None:
        data = super().send(event)
        if data is None:
            return None
        if isinstance(event, h11.Response):
            self._head = data
            return b""
        head, self._head = self._head, b""
        return head + data


def _cancelled(timer: asyncio.TimerHandle | None) -> None:
    if timer is not None:
        timer.cancel()
