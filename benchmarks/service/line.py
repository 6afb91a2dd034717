"""A minimal asyncio HTTP client for loads: less work per request than `http.client`, and no threads."""

import asyncio
import json
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from typing import Any, NamedTuple


class LineAnswer(NamedTuple):
    """An answer."""

    head: bytes
    body: bytes

    @property
    def status(self) -> int:
        return int(self.head[9:12])

    def header(self, name: str) -> str:
        """A header by its name in lower case, as the service writes them."""
        found = re.search(rf"^{name}: (.*?)\r$".encode(), self.head, re.MULTILINE)
        assert found, f"no {name} in {self.head!r}"
        return found[1].decode()


class Line:
    """A connection to a port of this machine, for one request at a time."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def post(self, path: str, body: Any) -> LineAnswer:
        """Send JSON; once more if the service has closed the connection, as it does after 5 idle seconds."""
        content = json.dumps(body).encode()
        start = f"POST {path} HTTP/1.1\r\nhost: 127.0.0.1\r\ncontent-type: application/json\r\n"
        message = f"{start}content-length: {len(content)}\r\n\r\n".encode() + content
        try:
            return await self._once(message)
        except (ConnectionError, asyncio.IncompleteReadError):
            await self.close()
            return await self._once(message)

    async def _once(self, message: bytes) -> LineAnswer:
        if self._streams is None:
            self._streams = await asyncio.open_connection("127.0.0.1", self._port, limit=1 << 20)
        reader, writer = self._streams
        writer.write(message)
        head = await reader.readuntil(b"\r\n\r\n")
        answer = LineAnswer(head, b"")
        return answer._replace(body=await reader.readexactly(int(answer.header("content-length"))))

    async def close(self) -> None:
        """Close the connection; the next request opens it again."""
        if self._streams is not None:
            writer, self._streams = self._streams[1], None
            writer.close()
            with suppress(ConnectionError):
                await writer.wait_closed()


@asynccontextmanager
async def connected(port: int) -> AsyncIterator[Line]:
    """A `Line` that is closed at the end."""
    line = Line(port)
    try:
        yield line
    finally:
        await line.close()
