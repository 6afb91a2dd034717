"""Admission of requests to the render queue."""

from collections.abc import Collection, Mapping
from contextlib import ExitStack

from starlette.routing import BaseRoute
from starlette.types import ASGIApp, Receive, Scope, Send

from msdgs_serve.api.errors import KIND, RequestRejected, rejection
from msdgs_serve.api.keys import client_of
from msdgs_serve.api.prefix import route_path
from msdgs_serve.api.work import WorkQueue

Call = tuple[str, str]
"""HTTP method and path."""


class Admission:
    """ASGI middleware that admits a request to the queue or rejects it, before its body is parsed and routed.

    Under overload most of the work is rejecting requests. A request for a single response with `If-None-Match` takes a
    place in the queue only once it has work.
    """

    def __init__(
        self, app: ASGIApp, queue: WorkQueue, routes: Mapping[Call, BaseRoute], streamed: Collection[Call]
    ) -> None:
        """`routes` are those that take a place in the queue; `streamed` are calls whose responses are streamed."""
        self._app = app
        self._queue = queue
        self._routes = routes
        self._streamed = streamed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        call = (scope["method"], route_path(scope)) if scope["type"] == "http" else ("", "")
        route = self._routes.get(call)
        if route is None:
            await self._app(scope, receive, send)
            return
        streamed = call in self._streamed
        at_once = streamed or not any(name == b"if-none-match" for name, _ in scope["headers"])
        with ExitStack() as place:
            try:
                place.enter_context(self._queue.admitted(client_of(scope), streamed=streamed, at_once=at_once))
            except RequestRejected as refused:
                scope["route"], scope[KIND] = route, refused.kind
                await rejection(refused)(scope, receive, send)
                return
            await self._app(scope, receive, send)
