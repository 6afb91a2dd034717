"""The service on Ray Serve, for those who run Ray already. Needs `msdgs[cluster]`.

    serve run msdgs_serve.cluster:application scenes=/data/scenes
    serve run msdgs_serve.cluster:application scenes=/data/scenes replicas=4 cores=8 queued_renders=32

Arguments are the settings of `msdgs-serve`, and `replicas` and `cores` of each. Where replicas are on several machines,
scenes lie where all see them. Ray's own proxy takes the connections: host, port, header_seconds, read_seconds and
drain_seconds are set there.
"""

import os
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from msdgs_serve.threads import THREADS_VARIABLE

if TYPE_CHECKING:
    from msdgs_serve.api.settings import Settings

ROOM_FOR_REFUSALS = 200
"""Requests that a replica may have beside those with a place in its queue: it answers them at once, with 503 and
`Retry-After`. Ray Serve would keep them waiting, or refuse them without saying for how long."""


def application(arguments: Mapping[str, str]) -> Any:
    """A Ray Serve application. Raises pydantic's `ValidationError` naming the argument that is wrong."""
    from msdgs_serve.api.settings import Settings

    given = dict(arguments)
    replicas, cores = int(given.pop("replicas", "1")), int(given.pop("cores", "1"))
    values: dict[str, Any] = {**given, "scenes": given.get("scenes", "").split(os.pathsep), "threads": cores}
    return deployment(Settings(**values), replicas, cores)


def deployment(settings: "Settings", replicas: int = 1, cores: int = 1) -> Any:
    """The service with these settings as a Ray Serve application, to be given to `serve.run`."""
    from ray import serve  # pyright: ignore[reportMissingImports]  # an extra

    places = settings.concurrent_renders + settings.queued_renders + ROOM_FOR_REFUSALS

    # made in the replica, as scenes and locks don't travel
    replica = serve.ingress(lambda: _service(settings, cores))()
    configured = serve.deployment(
        replica, name="msdgs", num_replicas=replicas, ray_actor_options={"num_cpus": cores},
        max_ongoing_requests=places, max_queued_requests=-1,
    )  # fmt: skip
    return configured.bind()


def _service(settings: "Settings", cores: int) -> Any:
    from msdgs_serve.api.app import create_app
    from msdgs_serve.renderer import Renderer
    from msdgs_serve.store import SceneStore

    os.environ[THREADS_VARIABLE] = str(cores)
    return create_app(SceneStore(settings.scenes), Renderer(settings.cache_megabytes << 20), settings)
