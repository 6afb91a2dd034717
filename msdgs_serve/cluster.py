"""The service as a Ray Serve application. Needs `msdgs[cluster]`.

    serve run msdgs_serve.cluster:application scenes=/data/scenes
    serve run msdgs_serve.cluster:application scenes=/data/scenes replicas=4 cores=8 queued_renders=32

Arguments are the settings of `msdgs-serve`, the number of `replicas` and the `cores` per replica. If replicas run on
several machines, all must be able to read the scenes. Settings without effect are refused: Ray's proxy handles the
connections, and Ray the logs.
"""

import asyncio
import os
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any

from msdgs_serve.scene import InvalidInput
from msdgs_serve.threads import THREADS_VARIABLE

if TYPE_CHECKING:
    from msdgs_serve.api.settings import Settings

MAX_REJECTIONS = 200
"""Requests that Ray sends to a replica beyond the places in its queue. The replica rejects them with 503 and
`Retry-After`; Ray Serve would let them wait, or reject them without `Retry-After`."""


WITHOUT_EFFECT = {
    "threads": "`cores` is the number of threads of a replica",
    "compile": "kernels are compiled when a replica starts",
    **dict.fromkeys(("log_level", "log_format"), "Ray writes the logs"),
    **dict.fromkeys(
        ("host", "port", "header_seconds", "read_seconds", "drain_seconds", "unread_megabytes"),
        "Ray's proxy handles the connections",
    ),
}
"""Settings of `msdgs-serve`, and what replaces them."""


def application(arguments: Mapping[str, str]) -> Any:
    """Return a Ray Serve application. Raises `InvalidInput` or pydantic's `ValidationError` naming the invalid
    argument."""
    return deployment(*read_arguments(arguments))


def read_arguments(arguments: Mapping[str, str]) -> tuple["Settings", int, int]:
    """Return the settings, the number of replicas and the cores of each. Raises as `application`."""
    from msdgs_serve.api.settings import Settings, split_list

    given = dict(arguments)
    replicas, cores = (_count(name, given.pop(name, "1")) for name in ("replicas", "cores"))
    for name in given.keys() - Settings.model_fields.keys():
        raise InvalidInput(name, "left out, as there is no such setting", given[name])
    for name in given.keys() & WITHOUT_EFFECT.keys():
        raise InvalidInput(name, f"left out, as {WITHOUT_EFFECT[name]}", given[name])
    lists = {name: split_list(name, given[name]) for name in ("scenes", "cors_origins") if name in given}
    settings = Settings(**{**given, **lists, "threads": cores})
    if not settings.scenes:
        raise InvalidInput("scenes", "scene files or folders of them", "nothing")
    return settings, replicas, cores


def _count(name: str, text: str) -> int:
    try:
        count = int(text)
    except ValueError:
        count = 0
    if count < 1:
        raise InvalidInput(name, "a whole number, 1 or more", text)
    return count


Message = Any
Send = Callable[[Message], Awaitable[None]]
Receive = Callable[[], Awaitable[Message]]

POLL_SECONDS = 0.05


def deployment(settings: "Settings", replicas: int = 1, cores: int = 1) -> Any:
    """Return the service with these settings as a Ray Serve application, for `serve.run`."""
    from ray import serve  # pyright: ignore[reportMissingImports]  # an extra

    places = settings.concurrent_renders + settings.queued_renders + MAX_REJECTIONS

    # created in the replica: scenes and locks can't be pickled
    replica = serve.ingress(lambda: _service(settings, cores))()
    configured = serve.deployment(
        replica, name="msdgs", num_replicas=replicas, ray_actor_options={"num_cpus": cores},
        max_ongoing_requests=places, max_queued_requests=-1,
    )  # fmt: skip
    return configured.bind()


def _service(settings: "Settings", cores: int) -> Any:
    """Return the FastAPI application of `msdgs-serve`, whose startup ends when its scenes are loaded."""
    from msdgs_serve.api.app import create_app
    from msdgs_serve.api.observe import REQUEST_ID
    from msdgs_serve.api.service import Phase
    from msdgs_serve.renderer import Renderer

    os.environ[THREADS_VARIABLE] = str(cores)
    renderer = Renderer(settings.cache_megabytes << 20, settings.sequence_megabytes << 20)
    app = create_app(settings.open_store(), renderer, settings)
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
    """ASGI middleware that removes a header from responses, which Ray's proxy adds itself."""

    def __init__(self, app: Callable[[Message, Receive, Send], Awaitable[None]], header: str) -> None:
        self._app = app
        self._name = header.lower().encode()

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        async def send_without(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = [each for each in message["headers"] if each[0].lower() != self._name]
                message = {**message, "headers": headers}
            await send(message)

        await self._app(scope, receive, send_without)
