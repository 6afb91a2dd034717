"""Writing of responses to connections."""

import asyncio
from collections.abc import AsyncIterator
from typing import Any
from unittest.mock import Mock

import pytest
import uvicorn
from starlette.responses import Response, StreamingResponse
from starlette.types import ASGIApp
from uvicorn.server import ServerState

from msdgs_serve.api.protocol import READ_BYTES, LimitedProtocol


def protocol_of(app: ASGIApp, transport: asyncio.Transport, **options: Any) -> LimitedProtocol:
    config = uvicorn.Config(app, log_config=None, lifespan="off")
    config.load()
    limits = {"header_seconds": 9, "read_seconds": 9}
    protocol = LimitedProtocol(config=config, server_state=ServerState(), app_state={}, **limits, **options)
    protocol.connection_made(transport)
    return protocol


def writes_of(app: ASGIApp, request: bytes) -> list[bytes]:
    async def ask() -> list[bytes]:
        transport = Mock(asyncio.Transport, is_closing=lambda: False, get_write_buffer_size=lambda: 0)
        protocol = protocol_of(app, transport)
        protocol.data_received(request)
        while protocol.tasks:
            await asyncio.sleep(0)
        protocol.connection_lost(None)
        return [bytes(call.args[0]) for call in transport.write.call_args_list if call.args[0]]

    return asyncio.run(ask())


GET = b"GET / HTTP/1.1\r\nHost: here\r\n\r\n"


@pytest.mark.parametrize(
    ("response", "request_", "body"),
    [
        (Response(b"body"), GET, b"body"),
        (Response(status_code=304), GET, b""),
        (Response(b"body"), GET.replace(b"GET", b"HEAD"), b""),
    ],
)
def test_an_answer_is_written_at_once(response: Response, request_: bytes, body: bytes):
    (answer,) = writes_of(response, request_)
    assert answer.startswith(b"HTTP/1.1 ")
    assert answer.endswith(b"\r\n\r\n" + body)


def test_parts_of_a_stream_are_written_as_they_come():
    async def parts() -> AsyncIterator[bytes]:
        yield b"one"
        yield b"two"

    first, second, end = writes_of(StreamingResponse(parts()), GET)
    assert first.startswith(b"HTTP/1.1 200 OK\r\n")
    assert b"one" in first
    assert b"two" in second
    assert end == b"0\r\n\r\n"


@pytest.mark.parametrize(("left", "is_closed"), [(READ_BYTES + 1, True), (READ_BYTES, False)])
def test_a_client_that_reads_too_little_in_time_is_closed(left: int, is_closed: bool):
    transport, loop = Mock(asyncio.Transport), Mock(asyncio.AbstractEventLoop)
    protocol = protocol_of(Response(), transport, _loop=loop)
    transport.get_write_buffer_size.return_value = 2 * READ_BYTES
    protocol.pause_writing()
    transport.get_write_buffer_size.return_value = left
    loop.call_later.call_args.args[1]()  # the time has passed
    assert transport.abort.called == is_closed
