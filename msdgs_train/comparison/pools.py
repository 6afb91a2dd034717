"""Workers that train the runs of a comparison: processes of this machine, or tasks of a Ray cluster."""

import dataclasses
import multiprocessing
import os
import signal
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any, NamedTuple

from msdgs_serve.process import STOPPING
from msdgs_serve.ray_tasks import RayTasks, ray_cluster
from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_serve.threads import THREADS_VARIABLE
from msdgs_serve.writing import in_words
from msdgs_train.comparison.matrix import Run
from msdgs_train.engine.observer import Observer
from msdgs_train.engine.run import fit
from msdgs_train.engine.run_record import CONFIG
from msdgs_train.engine.trainer import Trainer

POLL_SECONDS = 0.5
_stop: Event | None = None  # set in a worker process by its parent
_terminated = threading.Event()  # set by a signal to this process


class RunEnd(NamedTuple):
    """How a run has ended: "finished", "interrupted", "was finished", or "failed" with its message."""

    status: str
    message: str = ""


class Processes:
    """Trains up to `jobs` runs at a time, one process of this machine per run."""

    def __init__(self, jobs: int, executor: ProcessPoolExecutor, stop: Event) -> None:
        self.jobs = jobs
        self._executor, self._stop = executor, stop
        self._going: dict[Future[RunEnd], Run] = {}

    def __len__(self) -> int:
        """Return the number of runs that haven't ended."""
        return len(self._going)

    def submit(self, run: Run) -> None:
        """Start a run, or continue it."""
        signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING)  # of a new process, until it is prepared for them
        try:
            self._going[self._executor.submit(_train_here, run)] = run
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)

    def finished(self, timeout: float | None = None) -> Iterator[tuple[Run, RunEnd]]:
        """Yield the runs that have ended, after waiting for the first of them, up to `timeout` seconds.

        Raises `MsdgsError` if the process of a run was killed.
        """
        for future in wait(self._going, timeout=timeout, return_when=FIRST_COMPLETED).done:
            run = self._going.pop(future)
            try:
                end = future.result()
            except BrokenExecutor:
                problem = f"{run.name}: a training process was killed, perhaps for lack of memory"
                raise MsdgsError(f"{problem}; continue by the same command, with fewer --jobs") from None
            yield run, end

    def stop(self) -> None:
        """Make all runs save their checkpoint and end."""
        self._stop.set()


class RayPool(RayTasks[Run, RunEnd]):
    """Trains up to `jobs` runs at a time, as tasks of a Ray cluster."""

    def __init__(self, jobs: int, threads: int) -> None:
        import ray  # pyright: ignore[reportMissingImports]  # an extra

        self.jobs = jobs
        self._flag = ray.remote(num_cpus=0)(_Flag).remote()
        super().__init__(_train_on_ray, [self._flag], Path.cwd(), cores=threads)

    def stop(self) -> None:
        """Make all runs save their checkpoint and end."""
        self._flag.set.remote()


Pool = Processes | RayPool


@contextmanager
def processes(jobs: int) -> Iterator[Processes]:
    """A pool of processes of this machine."""
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    resource_tracker.ensure_running()  # which unblocks signals when it starts
    with ProcessPoolExecutor(jobs, context, _prepare, (stop,)) as executor:
        yield Processes(jobs, executor, stop)


@contextmanager
def ray_tasks(address: str, threads: int, jobs: int | None) -> Iterator[RayPool]:
    """A pool of tasks of a Ray cluster, `threads` cores each; as many as its cores allow if `jobs` is None.

    Data and runs must be at the same paths on all its machines. A run whose machine is lost continues on another one
    from its last checkpoint.
    """
    with ray_cluster(address) as cores:
        yield RayPool(jobs or max(1, cores // threads), threads)


class _Flag:
    """An actor on the cluster that runs poll for the request to stop."""

    def __init__(self) -> None:
        self._is_set = False

    def set(self) -> None:
        self._is_set = True

    def is_set(self) -> bool:
        return self._is_set


class _ComparisonObserver(Observer):
    """Stops a run when `is_stopped`, called every `POLL_SECONDS`, returns true; refuses one without images of the
    `splits`, which can't be evaluated."""

    def __init__(self, is_stopped: Callable[[], bool], splits: Sequence[str]) -> None:
        self._is_stopped, self._splits, self._called = is_stopped, splits, 0.0

    def on_train_start(self, trainer: Trainer) -> None:
        if not any(trainer.scene.splits.get(split) for split in self._splits):
            raise InvalidInput("data", "a dataset with held-out images, or split by llffhold", "training images alone")

    def should_stop(self) -> bool:
        now = time.monotonic()
        if now < self._called + POLL_SECONDS:
            return False
        self._called = now
        return self._is_stopped()


def _train_on_ray(flag: list[Any], folder: Path, run: Run) -> RunEnd:
    """Train one run; relative paths are those of `folder`, in which the command was given."""
    import ray  # pyright: ignore[reportMissingImports]

    there = dataclasses.replace(run, folder=folder / run.folder, data=folder / run.data)
    return _train(there, lambda: ray.get(flag[0].is_set.remote()))


def _train_here(run: Run) -> RunEnd:
    ended = _train(run, lambda: _is_orphan() or _terminated.is_set() or (_stop is not None and _stop.is_set()))
    if _is_orphan():
        os._exit(1)  # the executor would wait for more work forever
    return ended


def _is_orphan() -> bool:
    parent = multiprocessing.parent_process()
    return parent is not None and not parent.is_alive()


def _train(run: Run, is_stopped: Callable[[], bool]) -> RunEnd:
    """Train one run, from its checkpoint if there is one, until `is_stopped`."""
    os.environ[THREADS_VARIABLE] = str(run.config.run.threads)
    resume, observer = (run.folder / CONFIG).exists(), _ComparisonObserver(is_stopped, run.splits)
    try:
        result = fit(run.config, run.data, run.folder, resume=resume, observer=observer)
    except (MsdgsError, OSError) as error:
        return RunEnd("failed", in_words(error))
    except Exception as error:  # of a plugin; other runs continue
        traceback.print_exc()
        return RunEnd("failed", repr(error))
    return RunEnd(result.status)


def _prepare(stop: Event) -> None:
    global _stop
    _stop = stop
    for number in STOPPING:  # a terminal sends them to all processes; the parent passes them on
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: _terminated.set())  # sent to each, also by the executor
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPPING)
    warnings.simplefilter("ignore")  # as in the parent
