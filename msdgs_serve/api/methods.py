"""Methods of HTTP that a path takes: HEAD wherever GET is served, and what `Allow` says."""

from starlette.routing import BaseRoute, Match, Mount
from starlette.types import ASGIApp, Message, Receive, Scope, Send

METHODS = ("GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS")
ONLY_HEAD = "msdgs.only_head"
"""Key of an ASGI scope: whether only the head of the response is sent."""


def methods_at(scope: Scope) -> list[str]:
    """Return the methods that the path of a request takes; none if nothing is served there."""
    prefix = scope.get("app_root_path", scope.get("root_path", ""))  # Starlette adds that of static files to the latter
    place = {"type": "http", "path": scope["path"], "root_path": prefix}
    taken = {method for method in METHODS if any(_takes(route, place, method) for route in scope["app"].routes)}
    if "GET" in taken:
        taken.add("HEAD")
    return [method for method in METHODS if method in taken or (taken and method == "OPTIONS")]


def _takes(route: BaseRoute, place: Scope, method: str) -> bool:
    match, _ = route.matches({**place, "method": method})
    return match is Match.FULL and not (isinstance(route, Mount) and method != "GET")  # static files


class Head:
    """ASGI middleware that answers HEAD like GET, without the body."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] != "HEAD":
            await self._app(scope, receive, send)
            return

        async def send_head(message: Message) -> None:
            await send({**message, "body": b""} if message["type"] == "http.response.body" else message)

        scope["method"], scope[ONLY_HEAD] = "GET", True  # in this scope: the access log reads what is noted in it
        try:
            await self._app(scope, receive, send_head)
        finally:
            scope["method"] = "HEAD"
