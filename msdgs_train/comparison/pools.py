"""Workers that train the runs of a comparison: processes of this machine, or tasks of a Ray cluster."""

import dataclasses
import multiprocessing
import os
import signal
import time
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from msdgs_serve.ray_tasks import RayTasks, ray_cluster
from msdgs_serve.scene.errors import MsdgsError
from msdgs_serve.threads import THREADS_VARIABLE
from msdgs_train.comparison.matrix import Run
from msdgs_train.engine.observer import Observer
from msdgs_train.engine.run import fit
from msdgs_train.engine.run_record import CHECKPOINT

POLL_SECONDS = 0.5
_stop: Event | None = None  # of a worker process, set by its parent


class RunEnd(NamedTuple):
    """How a run has ended: "finished", "out of time", "interrupted", "was finished", or "failed" with its message."""

    status: str
    message: str = ""


class Pool(Protocol):
    """Trains `jobs` runs at a time."""

    jobs: int

    def __len__(self) -> int:
        """The number of runs that haven't ended."""
        ...

    def submit(self, run: Run) -> None:
        """Start a run, or continue it."""
        ...

    def ended(self) -> Iterator[tuple[Run, RunEnd]]:
        """The runs that have ended; waits up to `POLL_SECONDS`."""
        ...

    def stop(self) -> None:
        """Make all runs save their checkpoint and end."""
        ...


@contextmanager
def processes(jobs: int) -> Iterator[Pool]:
    """One process of this machine per run."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    with ProcessPoolExecutor(jobs, context, _prepare, (stop,)) as executor:
        yield _Processes(jobs, executor, stop)


@contextmanager
def ray_tasks(address: str, threads: int, jobs: int | None) -> Iterator[Pool]:
    """Tasks of a Ray cluster, `threads` cores each; as many as its cores allow if `jobs` is None.

    Data and runs must be at the same paths on all its machines. A run whose machine is lost continues on another one
    from its last checkpoint.
    """
    with ray_cluster(address) as cores:
        yield _RayPool(jobs or max(1, cores // threads), threads)


class _Processes:
    def __init__(self, jobs: int, executor: ProcessPoolExecutor, stop: Event) -> None:
        self.jobs = jobs
        self._executor, self._stop = executor, stop
        self._going: dict[Future[RunEnd], Run] = {}

    def __len__(self) -> int:
        return len(self._going)

    def submit(self, run: Run) -> None:
        self._going[self._executor.submit(_train_here, run)] = run

    def ended(self) -> Iterator[tuple[Run, RunEnd]]:
        for future in wait(self._going, timeout=POLL_SECONDS, return_when=FIRST_COMPLETED).done:
            yield self._going.pop(future), future.result()

    def stop(self) -> None:
        self._stop.set()


class _RayPool:
    def __init__(self, jobs: int, threads: int) -> None:
        import ray  # pyright: ignore[reportMissingImports]  # an extra

        self.jobs = jobs
        self._flag = ray.remote(num_cpus=0)(_Flag).remote()
        self._tasks: RayTasks[Run, RunEnd] = RayTasks(_train_on_ray, [self._flag], cores=threads)
        self._given: dict[Path, Run] = {}

    def __len__(self) -> int:
        return len(self._tasks)

    def submit(self, run: Run) -> None:
        there = dataclasses.replace(run, folder=run.folder.absolute(), data=run.data.absolute())
        self._given[there.folder] = run
        self._tasks.submit(there)

    def ended(self) -> Iterator[tuple[Run, RunEnd]]:
        for there, end in self._tasks.finished(POLL_SECONDS):
            yield self._given.pop(there.folder), end

    def stop(self) -> None:
        self._flag.set.remote()


class _Flag:
    """An actor on the cluster that runs poll for the request to stop."""

    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        self._is_set = True

    def is_set(self) -> bool:
        return self._is_set


class _FlagObserver(Observer):
    def __init__(self, flag: Any) -> None:
        self._flag = flag
        self._asked = 0.0

    def should_stop(self) -> bool:
        import ray  # pyright: ignore[reportMissingImports]

        now = time.monotonic()
        if now < self._asked + POLL_SECONDS:
            return False
        self._asked = now
        return ray.get(self._flag.is_set.remote())


class _ParentObserver(Observer):
    def should_stop(self) -> bool:
        return _is_orphan() or (_stop is not None and _stop.is_set())


def _train_on_ray(flag: list[Any], run: Run) -> RunEnd:
    return _train(run, _FlagObserver(flag[0]))


def _train_here(run: Run) -> RunEnd:
    ended = _train(run, _ParentObserver())
    if _is_orphan():
        os._exit(1)  # the executor would wait for more work forever
    return ended


def _is_orphan() -> bool:
    parent = multiprocessing.parent_process()
    return parent is not None and not parent.is_alive()


def _train(run: Run, observer: Observer) -> RunEnd:
    """Train one run, from its checkpoint if there is one."""
    os.environ[THREADS_VARIABLE] = str(run.config.run.threads)
    run.folder.mkdir(parents=True, exist_ok=True)
    try:
        result = fit(run.config, run.data, run.folder, resume=(run.folder / CHECKPOINT).exists(), observer=observer)
    except MsdgsError as error:
        return RunEnd("failed", str(error))
    return RunEnd(result.status)


def _prepare(stop: Event) -> None:
    global _stop
    _stop = stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to all processes; the parent passes it on
