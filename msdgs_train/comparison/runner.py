"""Trains the runs of a comparison, several side by side, each in a process of its own; goes on where it was stopped."""

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import replace
from multiprocessing.synchronize import Event
from typing import Any, NamedTuple

from msdgs_serve.scene.errors import InvalidInput, MsdgsError
from msdgs_serve.threads import THREADS_VARIABLE
from msdgs_train.comparison.matrix import Run
from msdgs_train.fit import CHECKPOINT, CONFIG, FINAL_METRICS, Observer, fit, stored_config

_stop: Event | None = None  # of a worker process, set by its parent


POLL_SECONDS = 0.5


class Ended(NamedTuple):
    """How a run has ended: "finished", "out of time", "interrupted", "was finished", or "failed" with its message."""

    status: str
    message: str = ""


def train_all(runs: Sequence[Run], jobs: int, on_end: Callable[[Run, Ended], None]) -> bool:
    """Train what isn't finished yet, `jobs` at a time; False where Ctrl-C has stopped it, with all checkpoints saved.

    Raises `InvalidInput` before anything is trained where a folder holds a run with other settings.
    """
    for run in runs:
        _check_settings(run)
    waiting = []
    for run in runs:
        if is_finished(run):
            on_end(run, Ended("was finished"))
        else:
            waiting.append(run)
    interrupted = threading.Event()
    old = signal.signal(signal.SIGINT, lambda *_: interrupted.set())
    context = multiprocessing.get_context("spawn")
    stop = context.Event()
    try:
        with ProcessPoolExecutor(min(jobs, len(waiting) or 1), context, _prepare, (stop,)) as pool:
            going: dict[Future[Ended], Run] = {}
            while waiting or going:
                if interrupted.is_set():
                    stop.set()
                    waiting.clear()
                while waiting and len(going) < jobs:
                    run = waiting.pop(0)
                    going[pool.submit(train, run)] = run
                for future in wait(going, timeout=POLL_SECONDS, return_when=FIRST_COMPLETED).done:
                    on_end(going.pop(future), future.result())
    finally:
        signal.signal(signal.SIGINT, old)
    return not interrupted.is_set()


def train(run: Run) -> Ended:
    """One run, begun or gone on with."""
    os.environ[THREADS_VARIABLE] = str(run.config.threads)
    run.folder.mkdir(parents=True, exist_ok=True)
    try:
        outcome = fit(run.config, run.data, run.folder, resume=(run.folder / CHECKPOINT).exists(), observer=_Listener())
    except MsdgsError as error:
        return Ended("failed", str(error))
    return Ended(outcome.status)


def is_finished(run: Run) -> bool:
    """Whether the budget has been spent and the result written."""
    metrics = final_metrics(run)
    minutes = run.config.max_minutes
    return metrics is not None and (
        metrics["step"] >= run.config.steps or (minutes is not None and metrics["seconds"] >= 60 * minutes)
    )


def final_metrics(run: Run) -> dict[str, Any] | None:
    """What `fit` has written at its end; None where it hasn't come to it."""
    try:
        return json.loads((run.folder / FINAL_METRICS).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError as error:
        raise InvalidInput("run", "a folder of a run", f"{run.folder / FINAL_METRICS}: {error}") from error


def _check_settings(run: Run) -> None:
    if not (run.folder / CONFIG).exists() or not (run.folder / CHECKPOINT).exists():
        return
    stored, wanted = (replace(config, threads=1).to_dict() for config in (stored_config(run.folder), run.config))
    for name, value in stored.items():
        if value != wanted[name]:
            raise InvalidInput(
                "out", "a new folder, or one of the same comparison", f"{run.folder} with other settings: {name}"
            )


class _Listener(Observer):
    def should_stop(self) -> bool:
        return _stop is not None and _stop.is_set()


def _prepare(stop: Event) -> None:
    global _stop
    _stop = stop
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal sends Ctrl-C to all; the parent passes it on
