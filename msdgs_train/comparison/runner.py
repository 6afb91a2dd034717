"""Training of the runs of a comparison, several in parallel, resumed after an interruption."""

import json
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any

from msdgs_serve.process import stopped_by
from msdgs_serve.scene.errors import InvalidInput
from msdgs_train.comparison.matrix import Run
from msdgs_train.comparison.pools import POLL_SECONDS, Pool, RunEnd
from msdgs_train.engine.config import differences
from msdgs_train.engine.run_record import CHECKPOINT, CONFIG, FINAL_METRICS, read_config


def train_all(runs: Sequence[Run], pool: AbstractContextManager[Pool], on_end: Callable[[Run, RunEnd], None]) -> bool:
    """Train the unfinished runs; returns False if Ctrl-C has stopped it, with all checkpoints saved.

    Raises `InvalidInput` before training if a folder holds a run with other settings.
    """
    for run in runs:
        _check_settings(run)
    waiting = []
    for run in runs:
        if is_finished(run):
            on_end(run, RunEnd("was finished"))
        else:
            waiting.append(run)
    if not waiting:
        return True
    interrupted = threading.Event()
    with pool as trainers:
        try:
            with stopped_by(lambda *_: interrupted.set()):  # here, after Ray has installed its own handler
                while waiting or len(trainers):
                    if interrupted.is_set():
                        trainers.stop()
                        waiting.clear()
                    while waiting and len(trainers) < trainers.jobs:
                        trainers.submit(waiting.pop(0))
                    for run, end in trainers.finished(POLL_SECONDS):
                        on_end(run, end)
                        if end.status == "interrupted":  # by a signal to its process
                            interrupted.set()
        except BaseException:
            trainers.stop()  # or the pool would wait until its runs have ended
            raise
    return not interrupted.is_set()


def is_finished(run: Run) -> bool:
    """Whether the budget has been spent and the result written."""
    metrics = final_metrics(run)
    return metrics is not None and metrics["step"] >= run.config.run.steps


def final_metrics(run: Run) -> dict[str, Any] | None:
    """Return the metrics that `fit` writes at its end; None if it hasn't ended."""
    try:
        return json.loads((run.folder / FINAL_METRICS).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except ValueError:
        raise InvalidInput("run", "a folder of a run", f"{run.folder}, whose {FINAL_METRICS} is damaged") from None


def _check_settings(run: Run) -> None:
    has_config, *has_results = ((run.folder / name).exists() for name in (CONFIG, CHECKPOINT, FINAL_METRICS))
    if not (has_config and any(has_results)):
        return
    changed = [name for name, *_ in differences(read_config(run.folder), run.config)]
    if changed:
        problem = f"{run.folder} with other settings: {', '.join(changed)}"
        raise InvalidInput("out", "a new folder, or one of the same comparison", problem)
