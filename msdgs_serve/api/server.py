"""uvicorn with limits on slow connections and a graceful shutdown."""

import asyncio
import socket
import time
from collections import Counter
from functools import partial
from types import FrameType

import uvicorn
from fastapi import FastAPI

from msdgs_serve.api.keys import client_of
from msdgs_serve.api.protocol import LimitedProtocol
from msdgs_serve.api.service import Phase, Service
from msdgs_serve.api.settings import Settings

CLOSING_SECONDS = 5  # for responses that are still being sent after all renders
POLL_SECONDS = 0.05


class Server(uvicorn.Server):
    """Serves an application from `create_app`. The first signal drains it, the second ends it at once.

    While it drains, it accepts connections and /ready answers 503, so that load balancers send requests elsewhere.
    """

    def __init__(self, app: FastAPI, settings: Settings) -> None:
        self.service: Service = app.state.service
        protocol = partial(LimitedProtocol, header_seconds=settings.header_seconds, read_seconds=settings.read_seconds)
        config = uvicorn.Config(
            app,
            http=protocol,  # pyright: ignore[reportArgumentType]
            log_config=None,
            access_log=False,
            timeout_graceful_shutdown=CLOSING_SECONDS,
            server_header=False,
            proxy_headers=False,  # the application reads them
        )
        super().__init__(config)
        self._drain_seconds = settings.drain_seconds
        self._drain_deadline = 0.0
        self.service.queue.unread = self._unread

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen at once, so that /live answers; call `on_ready` when scenes are loaded."""
        await super().startup(sockets)
        self._announcement = asyncio.ensure_future(self._announce())

    async def on_tick(self, counter: int) -> bool:
        """Whether to stop now."""
        if self.service.phase is Phase.FAILED:
            return True
        if self.service.phase is Phase.DRAINING and (self._is_idle() or time.monotonic() > self._drain_deadline):
            return True
        return await super().on_tick(counter)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Handle a signal."""
        if self.service.phase is Phase.DRAINING:
            self.should_exit = self.force_exit = True
        self._drain_deadline = time.monotonic() + self._drain_seconds
        self.service.drain()

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Close the connections, then the application; uvicorn doesn't close that after a second signal."""
        await super().shutdown(sockets)
        if self.force_exit:
            await self.lifespan.shutdown()

    def on_ready(self) -> None:
        """Called once when the service is ready."""

    def _is_idle(self) -> bool:
        """Whether no request is in progress, and clients have read all responses."""
        return not self.server_state.tasks and not self._unread()

    def _unread(self) -> Counter[str]:
        """Return the bytes of responses that clients haven't read yet, by client."""
        unread: Counter[str] = Counter()
        for connection in self.server_state.connections:
            if isinstance(connection, LimitedProtocol) and connection.scope and (unsent := connection.unsent_bytes):
                unread[client_of(dict(connection.scope))] += unsent
        return unread

    async def _announce(self) -> None:
        while self.service.phase is Phase.STARTING:
            await asyncio.sleep(POLL_SECONDS)
        if self.service.phase is Phase.READY:
            self.on_ready()
