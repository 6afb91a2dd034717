"""Scene files as responses, read in threads piece by piece."""

from collections.abc import AsyncIterator
from urllib.parse import quote

import anyio
import anyio.to_thread
from fastapi.responses import StreamingResponse
from starlette.types import Receive, Scope, Send

from msdgs_serve.api.methods import ONLY_HEAD
from msdgs_serve.scene import SceneFileInvalid
from msdgs_serve.scene_names import SUFFIX
from msdgs_serve.store import SceneContents

MEDIA_TYPE = "application/octet-stream"
PIECE = 1 << 18
"""Bytes that are read and sent at once."""


class SceneFileResponse(StreamingResponse):
    """Sends the open file of a scene and closes it, also if the client leaves.

    If another program writes into the file meanwhile, the connection is closed before the last byte, so that the client
    knows.
    """

    def __init__(self, contents: SceneContents, headers: dict[str, str], reading: anyio.CapacityLimiter) -> None:
        """`reading` limits the threads that read."""
        self._contents, self._reading = contents, reading
        self._left = contents.size
        headers = headers | {"Content-Length": str(contents.size)}
        super().__init__(self._pieces(), media_type=MEDIA_TYPE, headers=headers)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if ONLY_HEAD in scope:
            self._left = 0
        with self._contents.file:
            await super().__call__(scope, receive, send)

    async def _pieces(self) -> AsyncIterator[bytes]:
        # the last byte ends the response: the file may change from then on
        while self._left and (piece := await anyio.to_thread.run_sync(self._read, limiter=self._reading)):
            self._left -= len(piece)
            yield piece

    def _read(self) -> bytes:
        piece = self._contents.file.read(PIECE)
        if not self._contents.is_unchanged:
            raise SceneFileInvalid(self._contents.signature.path.name, "file", "has changed while it was sent")
        return piece


def file_headers(contents: SceneContents) -> dict[str, str]:
    """Return the headers that also a response without the file has."""
    return {
        "ETag": f'"{contents.sha256}"',
        "Cache-Control": "no-cache",
        "Content-Disposition": f"attachment; filename*=UTF-8''{quote(contents.name + SUFFIX, safe='')}",
    }
