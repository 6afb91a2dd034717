"""Tasks on a Ray cluster that are repeated if their worker or its machine is lost. Needs `msdgs[cluster]`."""

import itertools
import os
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Generic, NamedTuple, TypeVar

from msdgs_serve.scene import InvalidInput, MsdgsError

Item = TypeVar("Item")
Result = TypeVar("Result")

AUTO = "auto"
MAX_LOSSES = 5
TASKS_PER_CORE = 2
"""Tasks submitted per core: a running one and a waiting one."""


class RayUnavailable(MsdgsError):
    """Ray is not installed."""


class WorkLost(MsdgsError):
    """A task's worker died `MAX_LOSSES` times."""


class _Problem(NamedTuple):
    """The message of an `MsdgsError`, which can't be pickled itself."""

    message: str


@contextmanager
def ray_cluster(address: str) -> Iterator[int]:
    """Connect to Ray within the context; yield the number of the cluster's cores.

    `auto` is the cluster that runs on this machine or that RAY_ADDRESS names; if there is none, one is started for the
    duration of the context. Raises `RayUnavailable`, and `InvalidInput` if there is no cluster at `address`.
    """
    try:
        import ray  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError:
        raise RayUnavailable("drawing on other machines needs Ray: pip install 'msdgs[cluster]'") from None
    quiet = {"log_to_driver": False, "logging_level": "error"}
    try:
        ray.init(address=address, **quiet)
    except (ConnectionError, RuntimeError, ValueError) as error:
        if address != AUTO or os.environ.get("RAY_ADDRESS"):
            raise InvalidInput("--ray", f"`{AUTO}` or the address of a Ray cluster", f"{address} ({error})") from None
        ray.init(address="local", include_dashboard=False, **quiet)
    try:
        yield max(1, int(ray.cluster_resources().get("CPU", 1)))
    finally:
        ray.shutdown()


class RayTasks(Generic[Item, Result]):
    """Calls `function(*shared, item)` for each submitted item, on `cores` cores of one machine.

    References from `ray.put` in `shared` arrive as their values.
    """

    def __init__(self, function: Callable[..., Result], *shared: Any, cores: int = 1) -> None:
        import ray  # pyright: ignore[reportMissingImports]

        def guarded(*arguments: Any) -> Result | _Problem:
            try:
                return function(*arguments)
            except MsdgsError as error:
                return _Problem(str(error))

        # lost tasks are resubmitted here, so that all losses are counted
        self._call = ray.remote(num_cpus=cores, max_retries=0)(guarded)
        self._shared = shared
        self._running: dict[Any, Item] = {}
        self._losses: Counter[int] = Counter()

    def __len__(self) -> int:
        """Number of unfinished items."""
        return len(self._running)

    def submit(self, item: Item) -> None:
        """Queue an item."""
        self._running[self._call.remote(*self._shared, item)] = item

    def finished(self, timeout: float | None = None) -> Iterator[tuple[Item, Result]]:
        """Yield finished items with their results, after waiting at most `timeout` seconds for the first.

        Raises:
            MsdgsError: with the message of an error that the function raised.
            WorkLost: if the workers of an item were lost `MAX_LOSSES` times.
        """
        import ray  # pyright: ignore[reportMissingImports]
        from ray import exceptions  # pyright: ignore[reportMissingImports]

        lost = (
            exceptions.WorkerCrashedError, exceptions.NodeDiedError, exceptions.ObjectLostError,
            exceptions.OutOfMemoryError, exceptions.LocalRayletDiedError,
        )  # fmt: skip
        if not self._running:
            return
        ready, _ = ray.wait(list(self._running), num_returns=1, timeout=timeout)
        more, _ = ray.wait(list(self._running), num_returns=len(self._running), timeout=0)
        for reference in dict.fromkeys([*ready, *more]):
            item = self._running.pop(reference)
            try:
                result = ray.get(reference)
            except lost as error:
                self._resubmit(item, error)
                continue
            if isinstance(result, _Problem):
                raise MsdgsError(result.message)
            yield item, result

    def _resubmit(self, item: Item, error: Exception) -> None:
        self._losses[id(item)] += 1
        if self._losses[id(item)] >= MAX_LOSSES:
            reason = str(error).strip().splitlines()[0]
            raise WorkLost(f"a task lost its worker {MAX_LOSSES} times, last because: {reason}")
        self.submit(item)


def run_tasks(tasks: RayTasks[Item, Result], items: list[Item], cores: int) -> Iterator[tuple[Item, Result]]:
    """Yield all items with their results as they finish; few are submitted at a time, so that results don't pile up."""
    waiting = iter(items)
    for item in itertools.islice(waiting, TASKS_PER_CORE * cores):
        tasks.submit(item)
    while len(tasks):
        for finished in tasks.finished():
            for item in itertools.islice(waiting, 1):
                tasks.submit(item)
            yield finished
