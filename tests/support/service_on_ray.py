"""The service on Ray Serve, one cluster and one application a service, and tasks that fail there."""

import atexit
import contextlib
import functools
import itertools
import os
import warnings
from collections.abc import Iterator
from pathlib import Path

import httpx

from msdgs_serve.api.settings import Settings
from msdgs_serve.cluster import deployment
from msdgs_serve.scene import InvalidInput
from tests.support.processes import ROOT, free_port

OBJECT_STORE_BYTES = 100 << 20
CORES = 64  # Ray's number of cores: several services run at once
_numbers = itertools.count()


@contextlib.contextmanager
def serving_on_ray(settings: Settings) -> Iterator[httpx.Client]:
    """A client of a service with these settings. The cluster starts with the first and ends with the process."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Ray's own
        from ray import serve  # pyright: ignore[reportMissingImports]

        port, name = _cluster(), f"service{next(_numbers)}"
        serve.run(deployment(settings), name=name, route_prefix=f"/{name}")
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}/{name}", timeout=60) as client:
            yield client
    finally:
        serve.delete(name)


@functools.cache
def _cluster() -> int:
    import ray  # pyright: ignore[reportMissingImports]
    from ray import serve  # pyright: ignore[reportMissingImports]

    port = free_port()
    os.environ["PYTHONPATH"] = str(ROOT)
    os.environ.setdefault("RAY_agent_register_timeout_ms", "300000")  # Ray's default is short for a busy machine
    os.environ.setdefault("RAY_raylet_start_wait_time_s", "300")
    ray.init(
        address="local", include_dashboard=False, num_cpus=CORES, object_store_memory=OBJECT_STORE_BYTES,
        log_to_driver=False, logging_level="error",
    )  # fmt: skip
    atexit.register(ray.shutdown)
    serve.start(http_options={"host": "127.0.0.1", "port": port}, logging_config={"enable_access_log": False})
    return port


def dies_once(folder: Path, number: int) -> int:
    """End the worker process the first time that the marked item is processed."""
    marker = folder / "died"
    if number == 3 and not marker.exists():
        marker.touch()
        os._exit(1)
    return number * number


def always_dies(number: int) -> int:
    os._exit(number)


def refuses(number: int) -> int:
    raise InvalidInput("number", "another", number)
