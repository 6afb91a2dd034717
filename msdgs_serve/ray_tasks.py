"""Work on a Ray cluster: tasks that are given again where a worker or its machine is lost. Needs `msdgs[cluster]`."""

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
"""Tasks for each core: one that runs, and one whose turn comes when that has ended."""


class RayUnavailable(MsdgsError):
    """Ray is not installed."""


class WorkLost(MsdgsError):
    """A task's worker died again and again."""


class _Problem(NamedTuple):
    """An error of ours on its way back; the errors themselves can't be pickled."""

    message: str


@contextmanager
def ray_cluster(address: str) -> Iterator[int]:
    """A connection to Ray, which ends on leaving; yields how many cores the cluster has.

    `auto` is the cluster that runs on this machine (or that RAY_ADDRESS names); where there is none, one is started
    and stopped again. Raises `RayUnavailable`, and `InvalidInput` where nobody answers at `address`.
    """
    try:
        import ray  # pyright: ignore[reportMissingImports]  # an extra
    except ImportError:
        raise RayUnavailable("other machines are reached through Ray: pip install 'msdgs[cluster]'") from None
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
    """Calls `function(*shared, item)` for each item that is submitted, on `cores` cores of some machine.

    `shared` may hold what `ray.put` has returned, which comes as its value.
    """

    def __init__(self, function: Callable[..., Result], *shared: Any, cores: int = 1) -> None:
        import ray  # pyright: ignore[reportMissingImports]

        def guarded(*arguments: Any) -> Result | _Problem:
            try:
                return function(*arguments)
            except MsdgsError as error:
                return _Problem(str(error))

        # lost tasks are given again here, so that one way counts them all
        self._call = ray.remote(num_cpus=cores, max_retries=0)(guarded)
        self._shared = shared
        self._going: dict[Any, Item] = {}
        self._losses: Counter[int] = Counter()

    def __len__(self) -> int:
        """Items that haven't ended."""
        return len(self._going)

    def submit(self, item: Item) -> None:
        """Have it done when its turn comes."""
        self._going[self._call.remote(*self._shared, item)] = item

    def ended(self, timeout: float | None = None) -> Iterator[tuple[Item, Result]]:
        """What has ended meanwhile, after waiting for the first of it, `timeout` seconds at most.

        Raises:
            MsdgsError: what the function raised, as its message.
            WorkLost: if the machines that worked on an item were lost `MAX_LOSSES` times.
        """
        import ray  # pyright: ignore[reportMissingImports]
        from ray import exceptions  # pyright: ignore[reportMissingImports]

        lost = (
            exceptions.WorkerCrashedError, exceptions.NodeDiedError, exceptions.ObjectLostError,
            exceptions.OutOfMemoryError, exceptions.LocalRayletDiedError,
        )  # fmt: skip
        if not self._going:
            return
        ready, _ = ray.wait(list(self._going), num_returns=1, timeout=timeout)
        more, _ = ray.wait(list(self._going), num_returns=len(self._going), timeout=0)
        for reference in dict.fromkeys([*ready, *more]):
            item = self._going.pop(reference)
            try:
                result = ray.get(reference)
            except lost as error:
                self._again(item, error)
                continue
            if isinstance(result, _Problem):
                raise MsdgsError(result.message)
            yield item, result

    def _again(self, item: Item, error: Exception) -> None:
        self._losses[id(item)] += 1
        if self._losses[id(item)] >= MAX_LOSSES:
            reason = str(error).strip().splitlines()[0]
            raise WorkLost(f"work was lost {MAX_LOSSES} times with its worker, the last time as: {reason}")
        self.submit(item)


def in_turns(tasks: RayTasks[Item, Result], items: list[Item], cores: int) -> Iterator[tuple[Item, Result]]:
    """All items with their results as they end; a few are ahead of the cores, so that results don't pile up."""
    waiting = iter(items)
    for item in itertools.islice(waiting, TASKS_PER_CORE * cores):
        tasks.submit(item)
    while len(tasks):
        for ended in tasks.ended():
            for item in itertools.islice(waiting, 1):
                tasks.submit(item)
            yield ended
