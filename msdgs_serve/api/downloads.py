"""Scene files as responses: compressed if the client takes that, read in threads piece by piece."""

import math
from collections.abc import AsyncIterator
from urllib.parse import quote

import anyio
import anyio.to_thread
import zstandard
from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from msdgs_serve.api.methods import ONLY_HEAD
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.store import SUFFIX, SceneContents

MEDIA_TYPE = "application/octet-stream"
ZSTD = "zstd"
PIECE = 1 << 18
"""Bytes that are read and sent at once."""


class SceneFileResponse(StreamingResponse):
    """Sends the open file of a scene and closes it, also if the client leaves.

    If another program writes into the file meanwhile, the connection is closed before the last byte, so that the client
    knows.
    """

    def __init__(
        self, contents: SceneContents, headers: dict[str, str], reading: anyio.CapacityLimiter, *, compressed: bool
    ) -> None:
        """`reading` limits the threads that read and compress."""
        self._contents, self._source, self._reading = contents, contents.file, reading
        self._left = math.inf if compressed else contents.size
        if compressed:
            headers = headers | {"Content-Encoding": ZSTD}
            self._source = zstandard.ZstdCompressor().stream_reader(contents.file, contents.size)
        else:
            headers = headers | {"Content-Length": str(contents.size)}
        super().__init__(self._pieces(), media_type=MEDIA_TYPE, headers=headers)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if ONLY_HEAD in scope:
            self._left = 0
        with self._contents.file:
            await super().__call__(scope, receive, send)

    async def _pieces(self) -> AsyncIterator[bytes]:
        # the last byte ends a response of known length: the file may change from then on
        while self._left and (piece := await anyio.to_thread.run_sync(self._read, limiter=self._reading)):
            self._left -= len(piece)
            yield piece

    def _read(self) -> bytes:
        piece = self._source.read(PIECE)
        if not self._contents.is_unchanged:
            raise SceneFileInvalid(self._contents.signature.path.name, "file", "has changed while it was sent")
        return piece


def file_headers(contents: SceneContents, *, compressed: bool) -> dict[str, str]:
    """Return the headers that also a response without the file has."""
    return {
        "ETag": f'W/"{contents.sha256}"' if compressed else f'"{contents.sha256}"',
        "Vary": "Accept-Encoding",
        "Cache-Control": "no-cache",
        "Content-Disposition": f"attachment; filename*=UTF-8''{quote(contents.name + SUFFIX, safe='')}",
    }


def takes_zstd(accept_encoding: str | None) -> bool:
    """Whether `Accept-Encoding` names zstd, or `*`, with a weight above 0 and not below that of `identity`."""
    weights = dict(map(_weight, (accept_encoding or "").lower().split(",")))
    zstd = weights.get(ZSTD, weights.get("*", 0.0))
    return zstd > 0 and zstd >= weights.get("identity", 0.0)


def _weight(part: str) -> tuple[str, float]:
    coding, _, parameter = part.partition(";")
    name, _, number = parameter.partition("=")
    try:
        return coding.strip(), float(number) if name.strip() == "q" else 1.0
    except ValueError:
        return coding.strip(), 0.0
