"""The service on Ray Serve, for those who run Ray already. Needs `msdgs[cluster]`.

    serve run msdgs_serve.cluster:application scenes=/data/scenes
    serve run msdgs_serve.cluster:application scenes=/data/scenes replicas=4 cores=8 queued_renders=32

Arguments are the settings of `msdgs-serve`, and `replicas` and `cores` of each. Where replicas are on several machines,
scenes lie where all see them. Ray's own proxy takes the connections: host, port, header_seconds, read_seconds and
drain_seconds are set there.
"""

import asyncio
import os
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from msdgs_serve.threads import THREADS_VARIABLE

if TYPE_CHECKING:
    from msdgs_serve.api.settings import Settings

MAX_REJECTIONS = 200
"""Requests that a replica may have beside those with a place in its queue: it answers them at once, with 503 and
`Retry-After`. Ray Serve would keep them waiting, or refuse them without saying for how long."""


def application(arguments: Mapping[str, str]) -> Any:
    """A Ray Serve application. Raises pydantic's `ValidationError` naming the argument that is wrong."""
    from msdgs_serve.api.settings import Settings

    given = dict(arguments)
    replicas, cores = int(given.pop("replicas", "1")), int(given.pop("cores", "1"))
    values: dict[str, Any] = {**given, "scenes": given.get("scenes", "").split(os.pathsep), "threads": cores}
    return deployment(Settings(**values), replicas, cores)


Message = Any
Send = Callable[[Message], Awaitable[None]]
Receive = Callable[[], Awaitable[Message]]

POLL_SECONDS = 0.05


def deployment(settings: "Settings", replicas: int = 1, cores: int = 1) -> Any:
    """The service with these settings as a Ray Serve application, to be given to `serve.run`."""
    from ray import serve  # pyright: ignore[reportMissingImports]  # an extra

    places = settings.concurrent_renders + settings.queued_renders + MAX_REJECTIONS

    # made in the replica, as scenes and locks don't travel
    replica = serve.ingress(lambda: _service(settings, cores))()
    configured = serve.deployment(
        replica, name="msdgs", num_replicas=replicas, ray_actor_options={"num_cpus": cores},
        max_ongoing_requests=places, max_queued_requests=-1,
    )  # fmt: skip
    return configured.bind()


def _service(settings: "Settings", cores: int) -> Any:
    """The FastAPI application of `msdgs-serve`, which has begun when its scenes are loaded."""
    from msdgs_serve.api.app import create_app
    from msdgs_serve.api.observe import REQUEST_ID
    from msdgs_serve.api.service import Phase
    from msdgs_serve.renderer import Renderer
    from msdgs_serve.store import SceneStore

    os.environ[THREADS_VARIABLE] = str(cores)
    store = SceneStore(settings.scenes, settings.open_scene)
    app = create_app(store, Renderer(settings.cache_megabytes << 20), settings)
    service, begin = app.state.service, app.router.lifespan_context

    @asynccontextmanager
    async def loaded(app: Any) -> AsyncIterator[Any]:
        async with begin(app) as state:
            while service.phase is Phase.STARTING:
                await asyncio.sleep(POLL_SECONDS)
            if service.failure is not None:
                raise service.failure
            yield state

    app.router.lifespan_context = loaded
    app.add_middleware(_DropHeader, REQUEST_ID)
    return app


class _DropHeader:
    """Leaves a header out of answers: Ray's proxy, which has given the request its id, adds it too."""

    def __init__(self, app: Callable[[Message, Receive, Send], Awaitable[None]], header: str) -> None:
        self._app = app
        self._name = header.lower().encode()

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        async def shorter(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = [each for each in message["headers"] if each[0].lower() != self._name]
                message = {**message, "headers": headers}
            await send(message)

        await self._app(scope, receive, shorter)
