"""Calls that take a place in the queue of renders."""

from collections.abc import Callable, Coroutine
from typing import Any

from fastapi import Request, Response
from fastapi.routing import APIRoute

from msdgs_serve.api.service import Service


class QueuedRoute(APIRoute):
    """Refuses before a body is parsed: what is refused must cost nearly nothing. Who may have the answer already, by
    `If-None-Match`, needs no place."""

    def get_route_handler(self) -> Callable[[Request], Coroutine[Any, Any, Response]]:
        """That of the route, once the queue has a place."""
        handle = super().get_route_handler()

        async def unless_full(request: Request) -> Response:
            service: Service = request.app.state.service
            if "if-none-match" not in request.headers:
                service.queue.check_open()
            return await handle(request)

        return unless_full
