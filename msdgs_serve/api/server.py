"""uvicorn with limits on slow connections, and an end that finishes what was begun."""

import asyncio
import socket
import time
from types import FrameType

import uvicorn
from fastapi import FastAPI

from msdgs_serve.api.early_rejection import EarlyRejection
from msdgs_serve.api.protocol import limited_protocol
from msdgs_serve.api.service import Phase, Service
from msdgs_serve.api.settings import Settings

CLOSING_SECONDS = 5  # for what is still being sent when the work is done
POLL_SECONDS = 0.05


class Server(uvicorn.Server):
    """Serves an application from `create_app`. The first signal drains it, the second ends it at once.

    While it drains, /ready answers 503 on new connections too, so that who balances loads sends requests elsewhere.
    """

    def __init__(self, app: FastAPI, settings: Settings) -> None:
        self.service: Service = app.state.service
        # with keys or other origins a rejection depends on headers, which the application looks at
        is_plain = settings.api_keys_file is None and not settings.cors_origins
        early_rejection = (
            EarlyRejection(self.service.queue, self.service.metrics, settings.max_body_bytes) if is_plain else None
        )
        protocol = limited_protocol(settings.header_seconds, settings.read_seconds, early_rejection)
        config = uvicorn.Config(
            app,
            http=protocol,  # pyright: ignore[reportArgumentType]
            log_config=None,
            access_log=False,
            timeout_graceful_shutdown=CLOSING_SECONDS,
            server_header=False,
            forwarded_allow_ips=settings.proxies,
        )
        super().__init__(config)
        self._drain_seconds = settings.drain_seconds
        self._drained_by = 0.0

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Listen at once, so that /live answers; `on_ready` follows when scenes are loaded."""
        await super().startup(sockets)
        self._announcement = asyncio.ensure_future(self._announce())

    async def on_tick(self, counter: int) -> bool:
        """Whether to stop now."""
        if self.service.phase is Phase.FAILED:
            return True
        if self.service.phase is Phase.DRAINING and (self._is_idle() or time.monotonic() > self._drained_by):
            return True
        return await super().on_tick(counter)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """A signal came."""
        if self.service.phase is Phase.DRAINING:
            self.should_exit = self.force_exit = True
        self._drained_by = time.monotonic() + self._drain_seconds
        self.service.drain()

    def on_ready(self) -> None:
        """Called once, when the service can be used."""

    def _is_idle(self) -> bool:
        """Whether nothing is in work or being sent."""
        return not self.server_state.tasks

    async def _announce(self) -> None:
        while self.service.phase is Phase.STARTING:
            await asyncio.sleep(POLL_SECONDS)
        if self.service.phase is Phase.READY:
            self.on_ready()
