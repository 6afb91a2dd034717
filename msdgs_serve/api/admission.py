"""Calls that take a place in the queue of renders."""

from collections.abc import Mapping
from contextlib import ExitStack

from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Receive, Scope, Send

from msdgs_serve.api.errors import KIND, Refused, refusal
from msdgs_serve.api.prefix import route_path
from msdgs_serve.api.work import WorkQueue


class Admission:
    """ASGI middleware: gives a call its place, or refuses it, before its body is parsed and a route is looked for.

    Under too much load refusals are most of the work. Who may have the answer already, by `If-None-Match`, needs no
    place.
    """

    def __init__(self, app: ASGIApp, queue: WorkQueue, routes: Mapping[tuple[str, str], BaseRoute]) -> None:
        """`routes`: those that take a place, by method and path."""
        self._app = app
        self._queue = queue
        self._routes = routes

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        route = self._routes.get((scope["method"], route_path(scope))) if scope["type"] == "http" else None
        if route is None or any(name == b"if-none-match" for name, _ in scope["headers"]):
            await self._app(scope, receive, send)
            return
        with ExitStack() as place:
            try:
                place.enter_context(self._queue.admitted())
            except Refused as refused:
                scope["route"], scope[KIND] = route, refused.kind
                await refusal(refused)(scope, receive, send)
                return
            await self._app(scope, receive, send)
